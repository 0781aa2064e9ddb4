"""The updated Lagrangian frame, MLS-MPM with APIC as in the papers: its passes, rollout, and their adjoints."""
