"""Unknowns: from key paths in a scene to engine inputs, and gradients back."""
