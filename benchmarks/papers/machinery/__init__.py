"""What does the work behind figures, and publishes what came of it."""
