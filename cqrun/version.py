"""The version of cqrun: pyproject.toml has it too, and a test holds them equal."""

__version__ = "0.2.0"
