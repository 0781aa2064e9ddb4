"""What is measured on a rollout, one file each."""
