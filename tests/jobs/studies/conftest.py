"""A fleet without processes."""

from __future__ import annotations

import tempfile
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from cqrun.cli.app import app
from cqrun.running.fleet import Member


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a fleet run its members here, one after the other: starting a process takes longer than a small run."""

    def start(member: Member) -> None:
        words = list(member.command)
        result = CliRunner().invoke(app, words[words.index("cqrun") + 1 :])
        member.stderr = tempfile.TemporaryFile()  # noqa: SIM115  closed by the member
        member.stderr.write(result.stderr.encode())
        member.process = SimpleNamespace(poll=lambda: result.exit_code, returncode=result.exit_code)

    monkeypatch.setattr(Member, "start", start)
