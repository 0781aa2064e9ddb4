"""The reference frame (total Lagrangian): the weights never change, and the nodes carry the motion; its adjoints."""
