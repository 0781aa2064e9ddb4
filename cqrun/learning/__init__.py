"""Learning of control: agents, episodes, replays and environments."""
