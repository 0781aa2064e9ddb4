"""Unknowns of a scene as one vector, with bounds, scales and gradients."""
