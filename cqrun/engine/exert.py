"""The items of forces (`forces/force.py`) that a thread computes, and the sums of their cotangents; for both frames."""

from __future__ import annotations

from typing import Any

from cqrun.engine.setting import Crew
from cqrun.forces.force import ACTIVATION, FRICTION, REST, STRENGTH, Levels, exert, exert_jvp, exert_vjp
from cqrun.numerics.compile import for_each, kernel, share
from cqrun.plugin.contract import Array


@kernel
def exert_items(force: Any, levels: Levels, control: int, q: Array, crew: Crew) -> None:
    """Write the shares of one kind of force."""
    lo, hi = share(len(force.parts), crew.thread, crew.n_threads)
    for item in range(lo, hi):
        exert(force, item, levels, control, q)


@kernel
def exert_items_vjp(force: Any, levels: Levels, control: int, q: Array, push_bar: Array, crew: Crew) -> None:
    """Write the cotangents of the particles and parts of one kind of force."""
    lo, hi = share(len(force.parts), crew.thread, crew.n_threads)
    for item in range(lo, hi):
        exert_vjp(force, item, levels, control, q, push_bar)


@kernel
def exert_items_jvp(force: Any, levels: Levels, control: int, q: Array, move: Array, crew: Crew) -> None:
    """Write how the shares of one kind of force change with a displacement of the particles, to their x_bar."""
    lo, hi = share(len(force.parts), crew.thread, crew.n_threads)
    for item in range(lo, hi):
        exert_jvp(force, item, levels, control, q, move)


@kernel
def add_level_bars(force: Any, levels_bar: Levels, control: int) -> None:
    """Add the cotangents of the levels of one kind of force, item by item."""
    level_bar = force.shares.level_bar
    for item in range(len(force.parts)):
        a = force.parts[item]
        levels_bar.activation[control, a] += level_bar[item, ACTIVATION]
        levels_bar.strength[a] += level_bar[item, STRENGTH]
        levels_bar.rest[a] += level_bar[item, REST]
        levels_bar.friction[a] += level_bar[item, FRICTION]


exert_of_each = for_each(exert_items)
exert_of_each_vjp, exert_of_each_jvp = for_each(exert_items_vjp), for_each(exert_items_jvp)
add_level_bars_of_each = for_each(add_level_bars)
