"""Errors are for people: each says where, what is wrong, and what would be right.

The command line prints them without a traceback and ends with `exit_code`
(0 done, 1 the run failed, 2 bad scene or usage, 75 stopped but resumable, 130 interrupted).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cqrun.characters import printable


class CqrunError(Exception):
    """Base of every error that cqrun raises on purpose."""

    exit_code = 1


class UsageError(CqrunError):
    """Bad input other than a scene: a command line, a run directory, a data file."""

    exit_code = 2


class DataError(UsageError):
    """A recording or another data file that cannot be used as it is."""

    def __str__(self) -> str:
        """Return one line: what names in the file would do to a terminal is shown, not done."""
        return printable(super().__str__())


class MissingExtra(UsageError):
    """An optional dependency is needed but not installed; the message names the extra."""


class UnknownDistance(UsageError):
    """The distance from the surface of a kind of shape is not known, whatever its numbers and files are."""


class Stopped(CqrunError):
    """The run stopped early and can be resumed."""

    exit_code = 75


class StopAsked(Exception):
    """Raised between two rollouts if the run was asked to stop; what was computed before is kept."""


class StopNow(BaseException):
    """Raised by a signal where nothing waits for the work at hand, so that no handler of errors takes it for one."""


class RunError(CqrunError):
    """The run itself failed.

    Attributes:
        recording: the recording of a fit whose run it was, or "".
    """

    recording: str = ""


class InfeasibleError(RunError):
    """A run that ended before its constraints were met; the result that is closest to meeting them is kept.

    Args:
        run: directory of the run.
        verdict: which constraint is violated, and by how much.
    """

    def __init__(self, run: Path, verdict: str) -> None:
        self.run = run
        super().__init__(f"{run}: {verdict}")


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a scene.

    `where` is `file:line:column`, or `-o key=value` when an override caused it.
    """

    where: str
    path: str
    message: str

    def __str__(self) -> str:
        """Return one line; what names and values of a file would do to a terminal is shown, not done."""
        key = f"{self.path}: " if self.path else ""
        return printable(f"{self.where}: {key}{self.message}")


class SceneError(CqrunError):
    """A scene that cannot be run; carries every problem that was found."""

    exit_code = 2

    def __init__(self, problems: list[Problem]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(str(p) for p in self.problems))


class CrushedError(RunError):
    """A rollout that ended in an unusable state: the material at a marker is inverted or flat.

    Args:
        reason: where, in words.
        advice: what to change.
    """

    def __init__(self, reason: str, advice: str) -> None:
        self.reason, self.advice = reason, advice
        super().__init__(f"{reason}; {advice}")


class NoRestError(RunError):
    """A path of equilibria that ends early: no equilibrium was found under some loads.

    Args:
        reason: where, in words.
        advice: what to change.
    """

    def __init__(self, reason: str, advice: str) -> None:
        self.reason, self.advice = reason, advice
        super().__init__(f"{reason}; {advice}")


class RolloutError(RunError):
    """A rollout that had to stop: a value is not finite, or a particle reached the edge of the grid.

    Args:
        reason: what happened, in words.
        body: name of the body that the particle belongs to.
        particle: index of the particle inside that body.
        time: when it happened [s].
        advice: the likely cause, or what to change.
        group: name of a group of the body that contains the particle, or "".
    """

    def __init__(self, reason: str, *, body: str, particle: int, time: float, advice: str, group: str = "") -> None:
        self.reason, self.body, self.particle, self.group = reason, body, particle, group
        self.time, self.advice = time, advice
        of = f" (group '{group}')" if group else ""
        super().__init__(f"body '{body}', particle {particle}{of}, t = {time:.6g} s: {reason}; {advice}")


class RigidBodyError(RolloutError):
    """A rollout that had to stop because of a rigid body.

    Args:
        reason: what happened, in words.
        rigid: name of the rigid body.
        time: when it happened [s].
        advice: what to change.
    """

    def __init__(self, reason: str, *, rigid: str, time: float, advice: str) -> None:
        super().__init__(reason, body=rigid, particle=-1, time=time, advice=advice)
        self.args = (f"rigid body '{rigid}', t = {time:.6g} s: {reason}; {advice}",)
