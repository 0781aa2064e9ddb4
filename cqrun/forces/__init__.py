"""Forces on particles: those that depend on the state, and those that are steady through a control step."""
