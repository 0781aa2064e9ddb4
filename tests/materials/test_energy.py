"""The energy of every term that stores some: its derivative is the stress, and its adjoint is exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.materials.term import energy, energy_vjp, has_energy, kirchhoff
from cqrun.numerics.tensor import mul_bt
from cqrun.plugin.registry import plugins

ELASTIC = {"youngs_modulus": 2.0, "poissons_ratio": 0.3}
LAWS: dict[str, dict[str, Any]] = {
    "mooney_rivlin": {"c10": 0.5, "c01": 0.2},
    "yeoh": {"c10": 0.5, "c20": -0.1, "c30": 0.05},
    "gent": {"mu": 1.0, "jm": 10.0},
    "arruda_boyce": {"mu": 1.0, "lock": 2.0},
    "ogden": {"mu_1": 0.8, "alpha_1": 1.5, "mu_2": -0.2, "alpha_2": -2.0, "mu_3": 0.01, "alpha_3": 6.0},
}
TERMS: dict[tuple[str, str], list[dict[str, Any]]] = {
    ("elastic", "fixed_corotated"): [ELASTIC],
    ("elastic", "neo_hookean"): [ELASTIC],
    **{("elastic", name): [LAWS[name] | {"poissons_ratio": 0.3}, LAWS[name] | {"bulk_modulus": 3.0}] for name in LAWS},
    ("material_term", "incompressibility"): [{}, {"power": 4}],
    ("material_term", "fibre"): [
        {"directions": [[1, 0], [1, 2]], "tension_only": False},
        {"directions": [[1, 2]]},
    ],
    ("material_term", "viscosity"): [{"shear": 0.3, "bulk": 0.1}],
}
CASES = [(kind, name, fields) for (kind, name), every in TERMS.items() for fields in every]
EVERY = pytest.mark.parametrize(("kind", "name", "fields"), CASES, ids=[f"{c[1]}-{'-'.join(c[2])}" for c in CASES])
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
N = 11


def made(kind: str, name: str, fields: dict[str, Any], dim: int) -> tuple[Any, tuple[np.ndarray, ...], Any]:
    """Return a term's kernel view, its parameters, and random deformation gradients, also inverted where allowed."""
    rng = np.random.default_rng(4)
    start = [fields[p] for p in fields] if name in LAWS else [2.0, 0.3]
    theta = tuple(value * (1.0 + 0.1 * rng.uniform(size=N)) for value in start)
    F = np.eye(dim) + 0.25 * rng.normal(size=(N, dim, dim)) / dim
    if name in ("fixed_corotated", "incompressibility", "viscosity"):
        F[0, 0, 0] *= -1.0
    if name == "fibre":
        longer = [[*direction, 0.5][:dim] for direction in fields["directions"]]
        fields, theta = fields | {"directions": longer, "stiffness": 2.0}, theta[:1]
    return plugins(kind)[name](**fields).kernel_term(np.array(theta)), theta, tuple(F.reshape(N, -1).T.copy())


def test_every_term_of_the_package_has_an_energy():
    terms = [*((("elastic"), name) for name in plugins("elastic")),
             *(("material_term", name) for name in plugins("material_term") if name != "prony")]  # fmt: skip
    assert set(terms) == set(TERMS)


@EVERY
@DIM
def test_stress_is_the_derivative_of_the_energy(kind, name, fields, dim):
    term, theta, F = made(kind, name, fields, dim)
    assert has_energy(type(term))
    still = tuple(0.0 * entry for entry in F)
    P = energy_vjp(term, theta, F, np.ones(N))[1]
    for found, expected in zip(mul_bt(P, F), kirchhoff(term, theta, F, still), strict=True):
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


@EVERY
@DIM
def test_adjoint_is_that_of_the_energy(kind, name, fields, dim):
    term, theta, F = made(kind, name, fields, dim)
    rng, h = np.random.default_rng(8), 1e-4
    d_theta, d_F = ([rng.normal(size=N) for _ in part] for part in (theta, F))
    bar = rng.normal(size=N)

    def at(step: float) -> float:
        moved = [tuple(a + step * d for a, d in zip(part, along, strict=True))
                 for part, along in ((theta, d_theta), (F, d_F))]  # fmt: skip
        return float(bar @ energy(term, *moved))

    slope = sum(w * (at(k * h) - at(-k * h)) for k, w in ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))) / h
    theta_bar, F_bar = energy_vjp(term, theta, F, bar)
    found = sum(float(a @ b) for a, b in zip((*theta_bar, *F_bar), (*d_theta, *d_F), strict=True))
    assert found == pytest.approx(slope, rel=1e-9, abs=1e-9)
