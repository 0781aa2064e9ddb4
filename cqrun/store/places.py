"""Where results go, from the command line and from Python."""

from __future__ import annotations

from pathlib import Path

DEFAULT_OUT = Path("results")


def results_in(out: Path | str | None, source: Path) -> Path:
    """Return the folder for runs: the one that is given, or `results` beside the scene, wherever the command is typed.

    Args:
        out: the folder that is given.
        source: the scene's file, or a run to replay, whose results go where it is.
    """
    if out is not None:
        return Path(out)
    return source.resolve().parent.parent if source.is_dir() else source.parent / DEFAULT_OUT
