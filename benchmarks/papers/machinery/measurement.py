"""Work that is a function of ours, where no command of cqrun measures it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.papers.machinery.work import Work, digest
from cqrun.fingerprint import engine_hash

REMARK = "remark.json"
"""In the folder of a measurement: what is to be said beside its time, if anything."""


@dataclass(frozen=True)
class Measurement(Work):
    """A function of ours that measures something.

    Attributes:
        measure: (folder, deadline of time.monotonic) -> whether it is finished; it keeps what it has in the folder.
        told: what a reader would type.
        sources: files whose change makes it another measurement.
        settings: words of which the same is true.
        parts: how many there are of it, such as seeds; with more of them it goes on.
        alone: whether the whole machine is wanted, as where seconds are what is measured.
    """

    measure: Callable[[Path, float], bool]
    told: str
    sources: tuple[Path, ...] = ()
    settings: tuple[str, ...] = ()
    parts: int = 1
    alone: bool = False

    @property
    def is_alone(self) -> bool:
        """Say whether the whole machine is wanted."""
        return self.alone

    @property
    def command(self) -> str:
        """What a reader would type."""
        return self.told

    def fingerprint(self) -> str:
        """Return what its result depends on besides the engine, as hex digits."""
        return digest(*(word.encode() for word in (self.told, *self.settings)), *map(_content, self.sources))

    def done(self, folder: Path) -> dict[str, Any] | None:
        """Return what `done.json` says, or None where this is not done, or fewer parts of it."""
        facts = super().done(folder)
        return facts if facts is not None and facts.get("parts", self.parts) >= self.parts else None

    def remark(self, folder: Path) -> str:
        """Return what is to be said beside its time."""
        file = folder / REMARK
        return str(json.loads(file.read_text())) if file.exists() else ""

    def facts(self) -> dict[str, Any]:
        """Return the command and its parts."""
        return super().facts() | {"parts": self.parts}

    def go_on(self, folder: Path, seconds: float, jobs: int, share: float) -> bool:
        """Measure for so long at most; say whether it is finished. Rows of two engines are not mixed."""
        if self.engine(folder) != engine_hash():
            self.start_over(folder)
        return self.measure(folder, time.monotonic() + seconds)


def _content(path: Path) -> bytes:
    """Return what a file says: of a scene not its comments, nor its optimizer, which no measurement uses."""
    if path.suffix == ".yaml":
        scene = {key: value for key, value in yaml.safe_load(path.read_text()).items() if key != "optimizer"}
        return json.dumps(scene, sort_keys=True).encode()
    return path.read_bytes()
