"""A fixture that runs the command line and returns its output."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cqrun.cli import app as cli

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def cqrun(capsys: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs `cqrun` with some words and returns exit code, standard output and standard error."""

    def run(*words: str | Path) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(ended.value.code or 0), out, err

    return run
