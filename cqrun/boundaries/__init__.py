"""Boundary conditions on grid nodes, one file each."""
