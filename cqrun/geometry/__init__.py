"""Shapes, regions and samplings, one file each."""
