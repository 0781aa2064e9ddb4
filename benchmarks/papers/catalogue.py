"""All figures and tables, in the papers' order. Each class with an `id` in a module of figures/ is one."""

import importlib
import pkgutil
from collections.abc import Iterator

from benchmarks.papers import figures
from benchmarks.papers.figure import Figure

ORDER = (
    "cq1_table2", "cq1_table3", "cq1_inference", "cq1_fig3_actuate", "cq1_fig3_drop", "cq1_fig4", "cq1_biped_ppo",
    "cq1_fig5", "cq1_fig6", "cq1_crawler", "cq1_fig7_fixed", "cq1_fig7_random", "cq1_fig7_wide", "cq1_arm_reach",
    "cq1_fig8", "cq2_fig5", "cq2_fig6", "cq2_fig7", "cq2_fig8", "cq2_fig9", "cq2_fig10", "cq2_fig11", "cq2_fig12",
    "cq2_fig13", "cq2_fig14", "cq2_length_arm", "cq2_oscillator", "cq2_fracture", "cq2_seconds", "real_beam",
)  # fmt: skip
"""The papers' order. A figure that is not named here comes last."""


def _find_figures() -> Iterator[Figure]:
    for entry in pkgutil.iter_modules(figures.__path__):
        module = importlib.import_module(f"{figures.__name__}.{entry.name}")
        classes = (kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, Figure))
        for kind in classes:  # also imported ones, and base classes without an id
            if kind.__module__ == module.__name__ and "id" in vars(kind):
                yield kind()


FIGURES: dict[str, Figure] = {
    figure.id: figure for figure in sorted(_find_figures(), key=lambda figure: [*ORDER, figure.id].index(figure.id))
}
