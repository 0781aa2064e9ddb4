"""Formats of recordings, one file each; store/recordings.py selects one."""
