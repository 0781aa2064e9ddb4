"""Pictures of runs. They read run directories only, and draw without a display."""
