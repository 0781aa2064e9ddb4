"""Loads on particles, one file each."""
