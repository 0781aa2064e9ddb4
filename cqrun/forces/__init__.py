"""Forces on particles: those that depend on the state, and those that are constant in a control step."""
