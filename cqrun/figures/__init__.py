"""Pictures of runs, drawn from run directories without a display."""
