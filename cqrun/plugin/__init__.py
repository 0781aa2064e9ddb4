"""Plug-ins: what a field declares, the registry of names, and the choice of one in a scene."""
