"""Robots as labs build them: references from independent solutions, studies over resolutions, and their tables."""
