"""Section: the pictures of a run, with words for readers who do not see them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from cqrun.report.blocks import Block, Picture, Text
from cqrun.report.subject import Subject
from cqrun.report.words import short, some


def gallery(subject: Subject) -> Iterator[Block]:
    """Yield the pictures of a run; those of its recordings are in another section."""
    order = {name: k for k, name in enumerate(SHOWS)}
    shown = [path for path in subject.pictures if not path.stem.startswith("tracks_")]
    for path in sorted(shown, key=lambda path: (order.get(path.stem, len(order)), path.name)):
        describe = SHOWS.get(path.stem)
        alt, caption = (f"Picture '{path.stem}' of the run", path.stem) if describe is None else describe(subject)
        yield Picture(path, alt, caption)


def _overview(subject: Subject) -> tuple[str, str]:
    return "Overview of the run: its most important panels side by side.", "Overview"


def _bodies(subject: Subject) -> tuple[str, str]:
    names = some(subject.run.scene.bodies, 4)
    return f"The bodies ({names}) at the first, a middle and the last frame of the motion.", "The bodies over time"


def _convergence(subject: Subject) -> tuple[str, str]:
    loss = subject.run.history.get("loss")
    fell = "" if loss is None or not len(loss) else f" from {short(float(loss[0]))} to {short(float(loss[-1]))}"
    unknowns = ", and the unknowns" if subject.run.scene.unknowns else ""
    return f"The loss{fell}{unknowns} against the iteration.", "Convergence"


def _design(subject: Subject) -> tuple[str, str]:
    return f"The values that were found for {some(subject.run.scene.unknowns, 4)}, as colours on the body.", "Design"


def _shape(subject: Subject) -> tuple[str, str]:
    return "The shape of the body before and after the design.", "Shape before and after"


def _path(subject: Subject) -> tuple[str, str]:
    keys = some(subject.run.scene.path, 4)
    return f"Displacements and reactions along the path of equilibria over {keys}.", "Along the path"


def _reactions(subject: Subject) -> tuple[str, str]:
    scene = subject.run.scene
    return f"Force and moment of {some([*scene.boundaries, *scene.rigid], 4)} over time.", "Reactions"


def _measured(subject: Subject) -> tuple[str, str]:
    names = some(subject.run.scene.measure, 4)
    along = "along the path of equilibria" if subject.run.job == "rest" else "over time"
    return f"The measured quantities ({names}) {along}.", "Measured quantities"


SHOWS: dict[str, Callable[[Subject], tuple[str, str]]] = {
    "overview": _overview,
    "bodies": _bodies,
    "convergence": _convergence,
    "measured": _measured,
    "path": _path,
    "reactions": _reactions,
    "design": _design,
    "shape": _shape,
}
"""By the name of a picture: what it shows, and its caption; in the order of the page."""


def motion(subject: Subject) -> Iterator[Block]:
    """Yield the film of a run."""
    film = subject.film
    if film is None:
        return
    if film.path is None:
        yield Text(f"There is no film: {film.why}")
        return
    names = some(subject.run.scene.bodies, 4)
    if subject.run.job == "rest":
        alt = f"Film of the bodies ({names}) from the rest shape to point {film.last:g} of the path."
        yield Picture(film.path, alt, f"From the rest shape to point {film.last:g}, one picture for each point.", False)
        return
    speed = "in real time" if abs(film.speed - 1.0) < 0.02 else f"at {short(film.speed)} times the real speed"
    alt = f"Film of the bodies ({names}) from {film.first:.3g} to {film.last:.3g} s."
    yield Picture(film.path, alt, f"The motion from {film.first:.3g} to {film.last:.3g} s, {speed}.", False)
