"""Execution of jobs: threads, run directories, progress, parallel rollouts, and the memory of gradients."""
