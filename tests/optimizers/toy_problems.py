"""Small problems for the optimizers' tests, and a run that solves them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cqrun.optimizers.base import Optimizer, Outcome, TrialFailed
from cqrun.optimizers.constrained import ConstrainedOptimizer, report_names
from cqrun.store.run import RunDirectory
from cqrun.store.run_scene import RunScene
from cqrun.store.session import RunSession


class Killed(BaseException):
    """Simulates a SIGKILL in the middle of an evaluation."""


class Rosenbrock:
    """Rosenbrock's valley in n dimensions as residuals, split into parts; it can blow up and be killed.

    Args:
        n: number of unknowns.
        wall: the rollout blows up if x[0] is above it.
        fuse: number of evaluations before `Killed`.
    """

    term_names = ("valley", "slope")
    stochastic = False

    def __init__(self, n: int = 6, wall: float = np.inf, fuse: int | None = None, bound: float = np.inf):
        self.start = np.linspace(-1.2, 0.3, n)
        self.lower, self.upper = np.full(n, -bound), np.full(n, bound)
        self.n_batches = 2 * (n - 1)
        self.wall, self.fuse = wall, fuse
        self.evaluations = 0
        self._terms = np.zeros(2)

    def term_values(self):
        return self._terms

    def residuals(self, x):
        return self._evaluate(x)[0]

    def residuals_and_jacobian(self, x):
        return self._evaluate(x)

    def value(self, x, batch=None):
        return self.value_and_grad(x, batch)[0]

    def value_and_grad(self, x, batch=None):
        r, jacobian = self._evaluate(x)
        part = slice(None) if batch is None else list(batch)
        scale = 1.0 if batch is None else self.n_batches / len(batch)
        return scale * 0.5 * np.sum(r[part] ** 2), scale * np.sum(r[part, None] * jacobian[part], axis=0)

    def _evaluate(self, x):
        self.evaluations += 1
        if self.fuse is not None and self.evaluations > self.fuse:
            raise Killed
        if x[0] > self.wall:
            raise TrialFailed("left the grid", body="beam", particle=np.int64(7), time=0.25, values=f"a = {x[0]:.4g}")
        n = x.size
        valley, slope = 3.0 * (x[1:] - x[:-1] ** 2), 1.0 - x[:-1]
        jacobian = np.zeros((2 * (n - 1), n))
        rows = np.arange(n - 1)
        jacobian[rows, rows], jacobian[rows, rows + 1] = -6.0 * x[:-1], 3.0
        jacobian[n - 1 + rows, rows] = -1.0
        self._terms = np.array([0.5 * np.sum(valley**2), 0.5 * np.sum(slope**2)])
        return np.concatenate([valley, slope]), jacobian


class InNumbers:
    """Constraints with scale 1, and bounds described by number."""

    @property
    def scales(self):
        return np.ones(len(self.constraint_names))

    def bounds_in_words(self, below, above):
        return f"at bounds: {np.flatnonzero(below).tolist()} below, {np.flatnonzero(above).tolist()} above"


class Confined(InNumbers, Rosenbrock):
    """Rosenbrock's valley where the sum of x is 1 and x.x is at most `radius` squared; half of x in [-2, 2]."""

    constraint_names = ("sum", "ball")

    def __init__(self, n: int = 6, radius: float = 1.5, total: float = 1.0, **more):
        super().__init__(n, **more)
        self.lower, self.upper = np.full(n, -2.0), np.full(n, 2.0)
        self.c_low, self.c_high = np.array([total, -np.inf]), np.array([total, radius**2])

    def values_and_constraints(self, x):
        r, _ = self._evaluate(x)
        return 0.5 * float(r @ r), np.array([x.sum(), x @ x])

    def gradients_and_constraints(self, x):
        r, jacobian = self._evaluate(x)
        return 0.5 * float(r @ r), jacobian.T @ r, np.array([x.sum(), x @ x]), np.array([np.ones_like(x), 2.0 * x])

    def lagrangian(self, x, weigh):
        f, g, c, J = self.gradients_and_constraints(x)
        return f, c, g + weigh(c) @ J


class OnACircle(Confined):
    """Maratos' example in n dimensions: 2 (x.x - 1) - x_1 where x.x is 1 (Nocedal and Wright, example 15.4).

    Args:
        seed: seed of a random start on the circle; if None, the start is far from the minimum.
    """

    constraint_names = ("circle",)

    def __init__(self, n: int = 12, seed: int | None = None, **more):
        super().__init__(n, **more)
        far = np.where(np.arange(n) % 2, 1.0, -1.0)
        start = far if seed is None else np.random.default_rng(seed).normal(size=n)
        self.start = start / np.linalg.norm(start)
        self.c_low = self.c_high = np.array([1.0])

    def values_and_constraints(self, x):
        self._evaluate(x)
        return 2.0 * (x @ x - 1.0) - x[0], np.array([x @ x])

    def gradients_and_constraints(self, x):
        f, c = self.values_and_constraints(x)
        return f, 4.0 * x - np.eye(len(x))[0], c, 2.0 * x[None]


class Nearest(InNumbers):
    """The point nearest to `aim` where w.x is at most `most`: (aim - w max(0, w.aim - most) / w.w), by projection."""

    term_names = ()
    stochastic = False
    n_batches = 1
    constraint_names = ("plane",)

    def __init__(self, aim, w, most: float, box: float = 10.0):
        self.aim, self.w = np.asarray(aim, float), np.asarray(w, float)
        self.start = np.zeros_like(self.aim)
        self.lower, self.upper = self.start - box, self.start + box
        self.c_low, self.c_high = np.array([-np.inf]), np.array([most])

    def term_values(self):
        return np.zeros(0)

    def values_and_constraints(self, x):
        return 0.5 * float((x - self.aim) @ (x - self.aim)), np.array([self.w @ x])

    def gradients_and_constraints(self, x):
        f, c = self.values_and_constraints(x)
        return f, x - self.aim, c, self.w[None]

    def lagrangian(self, x, weigh):
        f, g, c, J = self.gradients_and_constraints(x)
        return f, c, g + weigh(c) @ J


def problem_for(method: Optimizer, **options) -> Rosenbrock:
    """Return the valley for testing a method, with constraints if the method supports them."""
    return Confined(**options) if isinstance(method, ConstrainedOptimizer) else Rosenbrock(**options)


def solve(
    out: Path, optimizer: Optimizer, problem: Rosenbrock | Nearest, *, stop=lambda: False, seed: int = 3, sabotage=None
) -> tuple[Outcome, RunSession]:
    """Start or resume the run below `out`; `sabotage(session)` may change the session first."""
    scene = RunScene("toy", "cqrun: 1\n", "cqrun: 1\n")
    with RunDirectory.open(scene, out, argv=["toy"], seed=seed, threads=1) as run:
        run.begin()
        blocks = {"a": slice(0, 1), "b": slice(1, problem.start.size)}
        session = RunSession(
            run,
            seed=seed,
            blocks=blocks,
            physical=lambda x: 2.0 * x,
            term_names=[*problem.term_names, *report_names(problem)],
            stop=stop,
        )
        if sabotage is not None:
            sabotage(session)
        outcome = optimizer.minimise(problem, session)
        run.finish(outcome.status, outcome.message)
        return outcome, session


def run_folder(out: Path) -> Path:
    """Return the only run below `out`."""
    (folder,) = out.glob("toy/*")
    return folder


def history_rows(out: Path) -> list[str]:
    """Return the rows of the history without seconds, and without the checksum of a row."""
    return [row.rsplit(",", 2)[0] for row in (run_folder(out) / "history.csv").read_text().splitlines()]


def bits(outcome: Outcome) -> tuple:
    """Return an outcome as a tuple whose equality is bit-for-bit."""
    return outcome.x.tobytes(), outcome.loss.hex(), outcome.status, outcome.message, outcome.iterations
