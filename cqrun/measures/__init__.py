"""Measured quantities: what a scene names under `measure`, over time, and its adjoint; one file each."""
