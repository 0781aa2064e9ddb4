"""One file a command; those that make runs are jobs (job.py), and table.py lists them."""
