"""Studies of several runs of one scene: from several seeds, and of several variants of a design."""
