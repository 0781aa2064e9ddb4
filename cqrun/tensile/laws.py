"""The elastic laws as functions of few numbers: which parameters are fitted, and how.

A law's parameters are those of its plug-in without the bulk modulus and Poisson's ratio, which do not matter for a body
that keeps its volume. A parameter with a lower limit is fitted by its logarithm above it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from annotated_types import Ge, Gt
from pydantic import ValidationError

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.materials.curves import Mode, nominal_stress
from cqrun.materials.moduli import Moduli, moduli_at
from cqrun.plugin.contract import Array, Plugin, field_unit, is_differentiable
from cqrun.plugin.registry import plugins

VOLUME = ("bulk_modulus", "poissons_ratio")
"""Parameters that are not fitted."""

NU = 0.4999
SMALLEST, LOWEST, HIGHEST = 1e-40, -95.0, 20.0
"""The smallest positive number in units of its scale (a term with a large exponent has a tiny modulus), and limits of
the logarithm."""

_ANY = 2.0
"""A value that every parameter of a law may have: the kernels' view needs some."""


@dataclass(frozen=True)
class Parameter:
    """A fitted number of a law.

    Attributes:
        name: the field.
        unit: `Pa`, or `1` for a number that is no modulus.
        least: its lower limit, or None.
    """

    name: str
    unit: str
    least: float | None

    @property
    def is_modulus(self) -> bool:
        """Whether the stress grows in proportion to the moduli of a law."""
        return self.unit == "Pa"

    def to_free(self, value: float, scale: float) -> float:
        """Return the number that an optimizer moves, for a value of the parameter; `scale` is a modulus [Pa]."""
        value = value / scale if self.is_modulus else value
        return value if self.least is None else float(np.log(max(value - self.least, SMALLEST)))

    def from_free(self, free: float, scale: float) -> float:
        """Return the parameter for the number that an optimizer moves."""
        value = free if self.least is None else self.least + float(np.exp(np.clip(free, LOWEST, HIGHEST)))
        return value * scale if self.is_modulus else value


@dataclass(frozen=True)
class Law:
    """An elastic law, with as many terms as its specification has.

    Attributes:
        spec: the plug-in with any values: its class selects the kernel.
        parameters: those that are fitted.
        terms: number of terms, or 0 for a law whose number is fixed.
        exponents: for each modulus whose product with another parameter has to be positive, the number of that
            parameter, as in terms mu_k, alpha_k. What is fitted is the logarithm of the product, so that the exponent
            may change its sign.
    """

    spec: Any
    parameters: tuple[Parameter, ...]
    terms: int = 0
    exponents: Mapping[int, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name that a scene uses."""
        return str(self.spec.name)

    @property
    def title(self) -> str:
        """The name in tables."""
        return f"{self.name}, {self.terms} term{'s' if self.terms > 1 else ''}" if self.terms else self.name

    @cached_property
    def _rows(self) -> tuple[list[int], Array]:
        names = list(self.spec.parameters)
        theta = np.array([getattr(self.spec, name) for name in names], dtype=float)
        return [names.index(parameter.name) for parameter in self.parameters], theta

    def theta(self, values: Array, ratio: float | None = None) -> Array:
        """Return the rows of parameters of the plug-in for the fitted values (p,)."""
        rows, theta = self._rows
        theta = theta.copy()
        theta[rows] = values
        if ratio is not None:
            theta[list(self.spec.parameters).index("poissons_ratio")] = ratio
        return theta

    def to_free(self, values: Array, scale: float) -> Array:
        """Return the numbers (p,) that an optimizer moves, for values of the parameters; `scale` is a modulus [Pa]."""
        free = [p.to_free(float(x), scale) for p, x in zip(self.parameters, values, strict=True)]
        for k, exponent in self.exponents.items():
            free[k] = float(np.log(max(float(values[k] * values[exponent]) / scale, SMALLEST)))
        return np.array(free)

    def from_free(self, free: Array, scale: float) -> Array:
        """Return the values (p,) of the parameters for the numbers that an optimizer moves."""
        values = [p.from_free(float(x), scale) for p, x in zip(self.parameters, free, strict=True)]
        for k, exponent in self.exponents.items():
            values[k] = scale * float(np.exp(np.clip(free[k], LOWEST, HIGHEST))) / (values[exponent] or SMALLEST)
        return np.array(values)

    def stress(self, values: Array, mode: Mode, stretch: Array) -> Array:
        """Return the nominal stress (n,) [Pa]; not finite beyond the limit of a law that has one."""
        with np.errstate(all="ignore"):
            return nominal_stress(self.spec, self.theta(values), mode, stretch)

    def stresses(self, values: Array, mode: Mode, stretch: Array) -> Array:
        """Return the nominal stress (m, n) [Pa] for m sets of values (m, p), in one call of the kernel."""
        theta = np.repeat(np.array([self.theta(own) for own in values]).T, len(stretch), axis=1)
        with np.errstate(all="ignore"):
            stress = nominal_stress(self.spec, theta, mode, np.tile(stretch, len(values)))
        return stress.reshape(len(values), len(stretch))

    def moduli(self, values: Array, ratio: float = NU) -> Moduli:
        """Return the moduli at rest, as numbers."""
        found = moduli_at(self.spec, self.theta(values, ratio)[:, None])
        assert found is not None
        return Moduli(*(float(np.ravel(value)[0]) for value in found))

    def made(self, values: Array, ratio: float) -> dict[str, float]:
        """Return the fields of the plug-in in a scene.

        Raises:
            ValidationError: the law does not allow these values.
        """
        fields = {p.name: float(value) for p, value in zip(self.parameters, values, strict=True)}
        cls: Any = type(self.spec)
        cls(**fields, poissons_ratio=ratio)
        return {**fields, "poissons_ratio": ratio}


def all_laws(names: Sequence[str] = ()) -> list[Law]:
    """Return every elastic law that has a shear modulus, with each number of terms that it may have.

    Args:
        names: those that are wanted; all if empty.

    Raises:
        UsageError: a name is unknown, or is of a law that is not fitted.
    """
    known = plugins("elastic")
    for name in names:
        if name not in known:
            raise UsageError(f"--law {name}: no elastic law has this name{suggest(name, known)}: {listed(known)}")
    laws = [law for name in names or known for law in laws_of(known[name])]
    if lost := [name for name in names if name not in [law.name for law in laws]]:
        raise UsageError(f"--law {lost[0]}: this law has no shear modulus or no Poisson's ratio, and is not fitted")
    return laws


def laws_of(cls: type[Plugin]) -> Iterator[Law]:
    """Yield an elastic law, once for each number of terms: fields such as `mu_1, alpha_1, mu_2, ...` are terms."""
    fitted = [name for name in cls.model_fields if name not in VOLUME and is_differentiable(cls, name)]
    if "poissons_ratio" not in cls.model_fields:
        return
    made: Any = cls
    numbered = {name: int(match[1]) for name in fitted if (match := re.search(r"_([0-9]+)$", name))}
    for terms in sorted(set(numbered.values())) or [0]:
        wanted = [name for name in fitted if numbered.get(name, 0) <= terms]
        try:
            spec = made(**dict.fromkeys(wanted, _ANY), poissons_ratio=NU)
        except ValidationError:
            continue
        parameters = tuple(_parameter(cls, name) for name in wanted)
        law = Law(spec, parameters, terms, _exponents(cls, wanted, parameters) if terms else {})
        if set(wanted) <= set(spec.parameters) and moduli_at(spec, law.theta(np.full(len(wanted), _ANY))[:, None]):
            yield law


def _exponents(cls: Any, names: Sequence[str], parameters: Sequence[Parameter]) -> dict[int, int]:
    """Return the exponent of each modulus of a law with terms, if the law refuses a product that is not positive."""
    found = {}
    for k, parameter in enumerate(parameters):
        end = parameter.name.rsplit("_", 1)[-1]
        partners = [i for i, p in enumerate(parameters) if p.name.endswith(f"_{end}") and not p.is_modulus]
        if not parameter.is_modulus or len(partners) != 1:
            continue
        values = dict.fromkeys(names, _ANY)
        try:
            cls(**values | {parameter.name: -_ANY, names[partners[0]]: -_ANY}, poissons_ratio=NU)
        except ValidationError:
            continue
        try:
            cls(**values | {names[partners[0]]: -_ANY}, poissons_ratio=NU)
        except ValidationError:
            found[k] = partners[0]
    return found


def _parameter(cls: type[Plugin], name: str) -> Parameter:
    metadata = cls.model_fields[name].metadata
    limits = [float(m.gt if isinstance(m, Gt) else m.ge) for m in metadata if isinstance(m, (Gt, Ge))]  # type: ignore[arg-type]
    return Parameter(name, field_unit(cls, name) or "1", max(limits, default=None))
