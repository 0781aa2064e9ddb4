"""Equilibrium in the reference frame: where a body rests, and how its rest depends on everything; no time."""
