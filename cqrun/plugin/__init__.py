"""Plug-ins: how they declare fields, the registry of their names, and how a scene chooses one."""
