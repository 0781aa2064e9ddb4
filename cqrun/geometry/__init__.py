"""Shapes and samplings, one file each."""
