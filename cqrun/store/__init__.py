"""Run directories, trajectories and recordings on disk."""
