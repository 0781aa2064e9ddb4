"""cqrun: differentiable soft-robot simulation by the material point method."""

__version__ = "0.1.0"
