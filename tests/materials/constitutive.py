"""The terms of a stress as the registry knows them, with parameters and states to try them at."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from cqrun.actuators.muscle import MuscleKernel as Muscle
from cqrun.materials.rubber import Rubber
from cqrun.materials.term import kirchhoff, kirchhoff_vjp
from cqrun.plugin import registry

RANGES = {
    "youngs_modulus": (1.0, 10.0), "poissons_ratio": (-0.3, 0.45), "bulk_modulus": (1.0, 10.0),
    "c10": (0.5, 2.0), "c01": (0.1, 0.5), "jm": (3.0, 10.0), "lock": (1.5, 3.0),
    "mu_1": (0.5, 2.0), "alpha_1": (1.2, 4.0), "mu_2": (-0.5, -0.1), "alpha_2": (-3.0, -1.0), "mu_3": (0.01, 0.1),
    "alpha_3": (5.0, 9.0),
}  # fmt: skip
"""Where parameters are drawn from that terms share, or that have no bounds; others from their own bounds."""

OWN = {
    "ogden": ("mu_1", "alpha_1"),
    "ogden:2": ("mu_1", "alpha_1", "mu_2", "alpha_2"),
    "ogden:3": ("mu_1", "alpha_1", "mu_2", "alpha_2", "mu_3", "alpha_3"),
}
"""The parameters of laws that may have several numbers of them."""

N = 12
"""States tried at a time."""


@dataclass(frozen=True)
class Term:
    """One term: its name, its plug-in, its kernel's view of parameters, and a draw of N of them (rows, N)."""

    name: str
    spec: Any
    kernel: Any
    theta: np.ndarray

    def tau(self, F: np.ndarray, C: np.ndarray, theta: np.ndarray | None = None) -> np.ndarray:
        """Return the Kirchhoff stress (N, D, D) for F, C (N, D, D), complex ones too."""
        theta = self.theta if theta is None else theta
        return matrices(kirchhoff(self.kernel, tuple(theta), entries(F), entries(C)))

    def vjp(self, F: np.ndarray, C: np.ndarray, tau_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cotangents of theta (rows, N), F and C (N, D, D)."""
        found = kirchhoff_vjp(self.kernel, tuple(self.theta), entries(F), entries(C), entries(tau_bar))
        return np.array([b + np.zeros(N) for b in found[0]]), matrices(found[1]), matrices(found[2])


def entries(A: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return matrices (N, D, D) as a tuple of D * D arrays."""
    return tuple(A.reshape(len(A), -1).T)


def matrices(a: tuple[Any, ...]) -> np.ndarray:
    """Return a tuple of D * D arrays as matrices (N, D, D)."""
    dim = 2 if len(a) == 4 else 3
    return np.array([entry + np.zeros(N) for entry in a]).T.reshape(N, dim, dim)


def elastic_names() -> list[str]:
    """Return the elastic laws of the registry."""
    return list(registry.plugins("elastic"))


def without_history() -> list[str]:
    """Return the further terms of a stress that have no history; tests of `prony` are in test_prony.py."""
    return [name for name, cls in registry.plugins("material_term").items() if not getattr(cls, "relaxes", False)]


def all_names() -> list[str]:
    """Return every term without history that a stress may have: elastic laws, further terms, and muscles."""
    variants = ["mooney_rivlin/bulk", "ogden:2", "ogden:3", "fibre:2", "fibre:t"]
    return [*elastic_names(), *variants, *without_history(), "incompressibility^4", "muscle"]


def make(name: str, dim: int, rng: np.random.Generator) -> Term:
    """Return a term by name, its parameters drawn at random.

    `name^p` is a term of another power, `name/bulk` a law whose bulk modulus is given in place of nu, and `name:k` one
    of k terms.
    """
    if name == "muscle":
        rows = dim * (dim + 1) // 2
        return Term(name, None, Muscle(None, (0,) * rows), rng.normal(size=(rows, N)))
    plain, _, power = name.partition("^")
    plain, _, bulk = plain.partition("/")
    plain = plain.partition(":")[0]
    if plain == "fibre":
        directions = [[1.0] + [0.0] * (dim - 1), [1.0, 2.0, 3.0][:dim]][: 1 + name.endswith(":2")]
        return of_class(name, known_terms()[plain], rng, directions=directions, tension_only=name.endswith("t"))
    known = known_terms()
    options = {"power": int(power)} if power else {}
    return of_class(name, known[plain], rng, bulk="bulk_modulus" if bulk else "poissons_ratio", **options)


def known_terms() -> dict[str, Any]:
    """Return the classes of all terms of a stress by name."""
    return registry.plugins("elastic") | registry.plugins("material_term")


def of_class(name: str, cls: Any, rng: np.random.Generator, bulk: str = "poissons_ratio", **options: Any) -> Term:
    """Return the term of a plug-in class; `bulk` is the parameter by which a law of rubber gets its bulk modulus."""
    names = (*OWN.get(name, cls.own), bulk) if issubclass(cls, Rubber) else cls.parameters
    theta = np.array([rng.uniform(*_range(cls, p), N) for p in names])
    given = {p: float(theta[r, 0]) for r, p in enumerate(names) if p in cls.model_fields}
    spec = cls(**given, **options)
    return Term(name, spec, spec.kernel_term(None), theta)


def _range(cls: Any, name: str) -> tuple[float, float]:
    if name in RANGES:
        return RANGES[name]
    limits = {}
    for bound in cls.model_fields[name].metadata:
        for key in ("gt", "ge", "lt", "le"):
            if hasattr(bound, key):
                limits[key[0]] = getattr(bound, key)
    low = limits.get("g", -1.0)
    high = limits.get("l", low + 2.0)
    return low + 0.1 * (high - low), high - 0.1 * (high - low)


def states(dim: int, rng: np.random.Generator, strain: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Return deformed and turning states F, C (N, D, D), strained by about so much, with det F > 0."""
    F = rotations(dim, rng) @ (np.eye(dim) + strain * rng.uniform(-1, 1, (N, dim, dim)) / dim**0.5)
    return F, rng.normal(size=(N, dim, dim))


def rotations(dim: int, rng: np.random.Generator) -> np.ndarray:
    """Return random rotations (N, D, D)."""
    Q = np.linalg.qr(rng.normal(size=(N, dim, dim)))[0]
    Q[:, 0] *= np.linalg.det(Q)[:, None]
    return Q


def t(A: np.ndarray) -> np.ndarray:
    """Return each matrix's transpose."""
    return np.swapaxes(A, -1, -2)


def adjoint_errors(term: Term, dim: int, rng: np.random.Generator) -> Iterator[tuple[str, float]]:
    """Yield, for theta, F and C, the relative error of the dot-product test against Richardson's differences.

    Differences of the plain-Python twin, 6th order in the step: the polar factor's Newton iteration looks at real
    parts alone, so that a complex step through it is not exact.
    """
    F, C = states(dim, rng)
    theta_dot, F_dot, C_dot = rng.normal(size=term.theta.shape), *rng.normal(size=(2, N, dim, dim))
    theta_dot *= 0.1 * np.abs(term.theta)
    # what the grid sends back is not symmetric
    tau_bar = rng.normal(size=(N, dim, dim))
    bars = term.vjp(F, C, tau_bar)
    zero = (0 * theta_dot, 0 * F_dot, 0 * C_dot)
    for k, (name, moved) in enumerate((("theta", theta_dot), ("F", F_dot), ("C", C_dot))):
        change = tuple(moved if j == k else zero[j] for j in range(3))

        def along(h: float, change: tuple[np.ndarray, ...] = change) -> np.ndarray:
            return (term.tau(F + h * change[1], C + h * change[2], term.theta + h * change[0]) * tau_bar).sum((1, 2))

        forward = richardson(along)
        product = bars[k] * moved
        backward = product.sum(0) if k == 0 else product.sum((1, 2))
        yield name, float(np.abs(backward - forward).max() / max(np.abs(forward).max(), 1e-3))


def richardson(f: Any, h: float = 4e-3) -> np.ndarray:
    """Return f'(0) by central differences at h, h/2, h/4, h/8, extrapolated."""
    table = [(f(s) - f(-s)) / (2 * s) for s in (h, h / 2, h / 4, h / 8)]
    for order in (4, 16, 64):
        table = [(order * b - a) / (order - 1) for a, b in itertools.pairwise(table)]
    return table[0]
