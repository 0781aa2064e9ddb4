"""The inputs of a run, which determine its name."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cqrun.errors import UsageError


def stem_of(scene: Path) -> str:
    """Return the name of a scene in its results: that of its file without the suffix, but never `.` or `..`.

    A run has its scene's name, which is that of the folder around it.
    """
    if scene.is_dir():
        return scene.resolve().parent.name
    return scene.stem if scene.stem.strip(".") else scene.name


@dataclass(frozen=True)
class RunScene:
    """The inputs of a run, which determine its name.

    Args:
        stem: name of the scene file without its suffix.
        resolved: the resolved scene as YAML text.
        original: the scene as typed.
        files: every file that the scene names, by the name in the scene.
        base: folder to which these names are relative; a resumed run looks for them there.
        job: the job, such as `sysid`; a scene has a separate run for each job.
        plugins: the plug-in files of the scene, by the name in the scene; the run keeps copies.
        tables: names of the files with measurements that the run may write.
    """

    stem: str
    resolved: str
    original: str
    files: Mapping[str, Path] = field(default_factory=dict)
    base: str = ""
    job: str = "sysid"
    plugins: Mapping[str, Path] = field(default_factory=dict)
    tables: tuple[str, ...] = ()

    def digest(self) -> str:
        """Return 12 hex digits over the job, the resolved scene and the contents of its files.

        Raises:
            UsageError: a file cannot be read.
        """
        return digest_of(self.job, self.resolved, self.contents())

    def contents(self) -> dict[str, str]:
        """Return the sha256 of every file, by name.

        Raises:
            UsageError: a file cannot be read.
        """
        hashes = {}
        for name, path in sorted({**self.files, **self.plugins}.items()):
            try:
                hashes[name] = hashlib.sha256(path.read_bytes()).hexdigest()
            except OSError as error:
                raise UsageError(f"{path}: cannot be read ({error.strerror}); the scene names it") from error
        return hashes


def digest_of(job: str, resolved: str, contents: Mapping[str, str]) -> str:
    """Return 12 hex digits: the hash of a job, a resolved scene and the sha256 of every file that it names."""
    digest = hashlib.sha256(_bytes(f"{job}\0{resolved}"))
    for name, content in contents.items():
        digest.update(_bytes(name) + b"\0" + bytes.fromhex(content))
    return digest.hexdigest()[:12]


def hash_of(text: str) -> str:
    """Return the sha256 of a text."""
    return hashlib.sha256(_bytes(text)).hexdigest()


def _bytes(text: str) -> bytes:
    return text.encode(errors="surrogateescape")  # names of files need not be UTF-8
