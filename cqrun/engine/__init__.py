"""The MLS-MPM engine: passes, step, rollout, checkpointing, and their adjoints."""
