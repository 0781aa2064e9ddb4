"""Docstrings as Markdown."""

from __future__ import annotations

import inspect
import re


def escaped(text: str) -> str:
    """Return text in which no sign means anything to Markdown, except code between backticks."""
    parts = re.split(r"(`[^`]+`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([\\*_<>\[\]$|{}#~^])", r"\\\1", part) for part in parts)


def docstring(cls: type) -> str:
    """Return the docstring of a class as Markdown: paragraphs, lists, and indented lines as code."""
    lines = inspect.cleandoc(cls.__doc__ or "").splitlines()
    out: list[str] = []
    for line in lines:
        if line.startswith("    "):
            out.append(line)
        elif line.lstrip().startswith("- "):
            indent = len(line) - len(line.lstrip())
            out.append(" " * indent + "- " + escaped(line.lstrip()[2:]))
        else:
            out.append(line[: len(line) - len(line.lstrip())] + escaped(line.lstrip()))
    return "\n".join(out)
