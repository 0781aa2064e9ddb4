"""The scene language: read a YAML file and return a validated scene with all defaults."""
