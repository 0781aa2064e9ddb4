"""Fits of a model to recordings, and their uncertainty."""
