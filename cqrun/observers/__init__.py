"""Observers: what a controller reads during a rollout, one file each."""
