"""Measurements, one file each: what a recording is, and how a model is compared with it."""
