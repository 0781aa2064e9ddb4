"""Keep two generations of a small state file, so that one is always intact."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cqrun.errors import UsageError
from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_bytes

GENERATION, ITERATION = "generation", "iteration"


class Snapshots:
    """Keeps the last two states of an optimizer in `<stem>.0.npz` and `<stem>.1.npz`, written alternately.

    Args:
        stem: path without the generation and suffix.
        note: called with a sentence when a damaged file is skipped.
    """

    def __init__(self, stem: Path, note: Callable[[str], None] = lambda text: None) -> None:
        self.paths = tuple(stem.with_name(f"{stem.name}.{i}.npz") for i in (0, 1))
        self._note = note
        self._generation: int | None = None

    def save(self, state: dict[str, Array]) -> None:
        """Replace the older generation by `state`, atomically.

        Raises:
            UsageError, RunError: the state cannot be written.
        """
        if self._generation is None:
            self.load()
        generation = (self._generation or 0) + 1
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **{GENERATION: np.asarray(generation)}, **state)
        write_bytes(self.paths[generation % 2], buffer.getvalue())
        self._generation = generation

    def load(self, rows: int | None = None) -> dict[str, Array] | None:
        """Return the newest intact state, or None if nothing was saved; `save` continues after it.

        Args:
            rows: number of rows of the history; the state of an iteration that has no row is not used.

        Raises:
            UsageError: there are files, but none is intact, or the history lacks rows for each.
        """
        present = [path for path in self.paths if path.exists()]
        intact = [state for path in present if (state := self._read(path)) is not None]
        if present and not intact:
            raise UsageError(
                f"{present[0]}: unreadable checkpoint, and no older one is intact; start the run over with --fresh"
            )
        usable = [state for state in intact if rows is None or int(state[ITERATION]) < rows]
        if intact and not usable:
            last = max(int(state[ITERATION]) for state in intact)
            raise UsageError(
                f"{present[0]}: the checkpoint is of iteration {last}, and history.csv has {rows} whole rows; start "
                "the run over with --fresh"
            )
        if len(usable) < len(intact):
            self._note("history.csv lacks the last rows: it continues from the checkpoint before them")
        newest = max(usable, key=lambda state: int(state[GENERATION]), default=None)
        self._generation = 0 if newest is None else int(newest.pop(GENERATION))
        return newest

    def _read(self, path: Path) -> dict[str, Array] | None:
        try:
            data = path.read_bytes()
            with zipfile.ZipFile(io.BytesIO(data)) as archive:  # numpy does not check every CRC
                damaged = archive.testzip()
            if damaged is None:
                with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                    state = {name: arrays[name] for name in arrays.files}
                int(state[GENERATION]), int(state[ITERATION])
                return state
            reason = f"checksum of {damaged} is wrong"
        except Exception as error:  # a damaged archive may raise anything
            reason = str(error)
        self._note(f"{path.name}: unreadable ({reason}); the generation before it is used instead")
        return None
