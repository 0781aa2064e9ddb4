"""Learning to act: agents, episodes, replays and environments."""
