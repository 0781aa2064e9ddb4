"""Objectives: the terms of a loss, one file each."""
