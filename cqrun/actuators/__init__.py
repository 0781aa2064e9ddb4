"""Actuators, one file each."""
