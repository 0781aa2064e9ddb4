"""Section: how to cite cqrun and the papers of its method."""

from __future__ import annotations

import re
from collections.abc import Iterator

from cqrun.report.blocks import Block, Code, Text
from cqrun.report.subject import MISSING, Subject

PAPERS = """@inproceedings{hu2019chainqueen,
  title     = {{ChainQueen}: A Real-Time Differentiable Physical Simulator for Soft Robotics},
  author    = {Hu, Yuanming and Liu, Jiancheng and Spielberg, Andrew and Tenenbaum, Joshua B. and
               Freeman, William T. and Wu, Jiajun and Rus, Daniela and Matusik, Wojciech},
  booktitle = {International Conference on Robotics and Automation (ICRA)},
  year      = {2019},
  eprint    = {1810.01054},
  doi       = {10.1109/ICRA.2019.8794333}
}

@article{spielberg2021advanced,
  title   = {Advanced soft robot modeling in {ChainQueen}},
  author  = {Spielberg, Andrew and Du, Tao and Hu, Yuanming and Rus, Daniela and Matusik, Wojciech},
  journal = {Robotica},
  year    = {2021},
  doi     = {10.1017/S0263574721000722}
}"""
"""The two ChainQueen papers as BibTeX."""


def cite(subject: Subject) -> Iterator[Block]:
    """Yield BibTeX of the version that made a run, and of the papers."""
    yield from citation(subject.fact("versions", "cqrun"), subject.fact("engine"))


def citation(version: str, engine: str) -> Iterator[Block]:
    """Yield BibTeX of a version of cqrun and of the papers."""
    fields = ["title   = {{cqrun}: differentiable soft-robot simulation by the material point method}",
              "author  = {{The cqrun authors}}"]  # fmt: skip
    fields += [] if version == MISSING else [f"version = {{{_literal(version)}}}"]
    fields += [] if engine == MISSING else [f"note    = {{Engine {_literal(engine)}}}"]
    yield Text("Please cite cqrun, and the papers whose method it implements.")
    yield Code("@software{cqrun,\n  " + ",\n  ".join(fields) + "\n}\n\n" + PAPERS)


def _literal(text: str) -> str:
    """Return a text without what BibTeX would read as a command."""
    return re.sub(r"[{}\\$%#&~^]", "", text)
