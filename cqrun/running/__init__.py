"""Running: threads, run directories, progress, rollouts side by side, and the memory of gradients."""
