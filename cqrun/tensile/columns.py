"""What the column of a test means, by its name and unit: its role, and how the strain was measured."""

from __future__ import annotations

import re
from dataclasses import dataclass

from cqrun.tensile.units import kinds_of, tidy

ROLES = {
    "time": "time",
    "strain": "strain",
    "true_strain": "strain",
    "stretch": "strain",
    "extension": "length",
    "stress": "stress",
    "true_stress": "stress",
    "force": "force",
}
"""Kind of quantity by role."""

CROSSHEAD, OPTICAL = "crosshead", "optical"
_OPTICAL = re.compile(r"optical|video|\bdic\b|extensomet|laser|camera|image|vic-?[23]d|\bave\b|markers?")
_CROSSHEAD = re.compile(r"cross-?head|travers|machine|\bgrips?\b|\bglobal\b|stroke|standardweg")

_NOTHING = re.compile(
    r"\brates?\b|modulus|energy|temperature|\bwork\b|cycle|count|index|transverse|lateral|\bwidth\b|\bquer|poisson|"
    r"speed|power"
)
_TRUE = re.compile(r"\btrue\b|\blog|hencky|cauchy|wahr|vrai")
_WORDS = (
    ("time", re.compile(r"\btime\b|\bzeit\b|\btemps\b|\btiempo\b|^t$")),
    ("stretch", re.compile(r"stretch|lambda|λ|extension ratio|elongation ratio")),
    ("stress", re.compile(r"stress|spannung|contrainte|esfuerzo|sigma|\u03c3|piola|\bpk1\b")),
    ("strain", re.compile(r"strain|dehnung|d[ée]formation|epsilon|ε|\beps\b|verformung|stauchung")),
    ("force", re.compile(r"force|\bload\b|kraft|fuerza|charge")),
    (
        "extension",
        re.compile(r"extension|displacement|cross-?head|position|travel|weg\b|d[ée]placement|travers|stroke|"
                   r"elongation|verl[äa]ngerung|allongement"),
    ),
)  # fmt: skip
_BY_UNIT = {"strain": "strain", "length": "extension", "stress": "stress", "force": "force"}
_IN_BRACKETS = re.compile(r"^(.*?)\s*[(\[<]\s*([^()\[\]<>]*?)\s*[)\]>]\s*$", re.DOTALL)
_BEHIND_A_SIGN = re.compile(r"^(.*?)(?:\s+in\s+|\s*[/,;:]\s*|_|\s+)([^\s_,;:]+)$", re.DOTALL)


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        place: its number, from 0.
        name: as in the file, without the unit.
        unit: as in the file; empty if there is none.
        role: one of `ROLES`, or empty.
        strain_by: `crosshead`, `optical` or empty.
    """

    place: int
    name: str
    unit: str
    role: str
    strain_by: str = ""

    @property
    def label(self) -> str:
        """Its number, from 1, and its name."""
        return f"{self.place + 1} '{self.name}'" if self.name else f"{self.place + 1}"


def column_of(place: int, header: str, unit: str = "") -> Column:
    """Return a column by its header, and by the cell of a row of units below it."""
    name, own = split_unit(header)
    unit = tidy(unit.strip(" ()[]")) or own
    words = name.lower().replace("_", " ")
    return Column(place, name, unit, _role(words, unit), strain_by(words))


def split_unit(header: str) -> tuple[str, str]:
    """Return name and unit of `Stress (MPa)`, `Kraft / N`, `nominal_stress_MPa` or `Force, N`."""
    header = header.strip(' \t"')
    if match := _IN_BRACKETS.match(header):
        return match[1].strip(), tidy(match[2])
    match = _BEHIND_A_SIGN.match(header)
    if match and match[1].strip() and kinds_of(match[2]) and match[2] not in ("1", "-"):
        return match[1].strip(), tidy(match[2])
    return header, ""


def strain_by(words: str) -> str:
    """Return how a strain was measured, as far as words (lower case) tell."""
    return OPTICAL if _OPTICAL.search(words) else CROSSHEAD if _CROSSHEAD.search(words) else ""


def _role(words: str, unit: str) -> str:
    if _NOTHING.search(words):
        return ""
    role = next((role for role, pattern in _WORDS if pattern.search(words)), "")
    kinds = kinds_of(unit) if unit else []
    if kinds and role and ROLES[role] not in kinds:  # an elongation in %, a load in MPa
        role = next((_BY_UNIT[kind] for kind in kinds if kind in _BY_UNIT and role != "time"), "")
    return f"true_{role}" if role in ("strain", "stress") and _TRUE.search(words) else role
