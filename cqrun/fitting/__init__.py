"""Fits: a model held against recordings, and how sure the result is."""
