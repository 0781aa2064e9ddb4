"""Files are written completely or not at all, and disk errors become clear messages."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from cqrun.errors import RunError, UsageError
from cqrun.store.atomic import append_durably, make_directory, write_bytes, write_json, write_text


def test_text_and_json_replace_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_text(path, "old µ")
    assert path.read_text() == "old µ"
    write_json(path, {"b": [1.5, None], "a": "µ"})
    assert path.read_text() == '{\n  "b": [\n    1.5,\n    null\n  ],\n  "a": "µ"\n}\n'
    assert list(tmp_path.iterdir()) == [path]


def test_json_has_no_nan(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.ENOSPC, RunError, "disk is full.*Free some space"),
        (errno.EROFS, UsageError, "cannot be written.*--out"),
        (errno.EACCES, UsageError, "cannot be written.*--out"),
        (errno.EIO, RunError, "cannot be written"),
    ],
)
def test_errors_keep_the_old_file_and_say_what_to_do(tmp_path, monkeypatch, number, kind, words):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail(handle):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(kind, match=f"a.txt: .*{words}"):
        write_bytes(path, b"new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_directory_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="another place with --out"):
        make_directory(tmp_path / "file" / "below")


def test_append_writes_all_data(tmp_path):
    path = tmp_path / "log"
    with path.open("wb", buffering=0) as file:
        append_durably(file, b"abc")
        append_durably(file, b"de" * 100_000)
    assert path.read_bytes() == b"abc" + b"de" * 100_000


def test_a_file_that_cannot_grow(tmp_path):
    """A real limit of the operating system, in a separate process."""
    limit = 4096
    code = (
        "import resource, sys; from pathlib import Path; from cqrun.store.atomic import write_bytes;"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}));"
        "write_bytes(Path(sys.argv[1]), bytes(100_000))"
    )
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] != limit
    path = tmp_path / "big"
    answer = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert answer.returncode == 1
    assert f"RunError: {path}: cannot be written (File too large)" in answer.stderr
    assert not list(tmp_path.iterdir())
