"""Scenes: YAML in, a validated and resolved scene out."""
