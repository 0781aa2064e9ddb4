"""`cqrun material`: from the files of a testing machine to a material for scenes."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import PluginFiles, Quiet
from cqrun.cli.terminal import echo
from cqrun.errors import UsageError

Texts = list[str] | None


class Unloading(StrEnum):
    """What to do with unloading and reloading."""

    cut = "cut"
    keep = "keep"


def material(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="FILES...", help="Tests of one material, as the machine wrote them.")
    ] = None,
    column: Annotated[
        Texts,
        typer.Option(
            metavar="WHAT=COLUMN",
            help="Which column (number from 1, or name) is strain, true_strain, stretch, extension, stress, "
            "true_stress, force or time (repeatable).",
        ),
    ] = None,
    unit: Annotated[
        Texts, typer.Option(metavar="WHAT=UNIT", help="Unit of such a column: stress=MPa, strain=% (repeatable).")
    ] = None,
    mode: Annotated[
        Texts,
        typer.Option(metavar="MODE", help="uniaxial, planar or equibiaxial; FILE=MODE for one file (repeatable)."),
    ] = None,
    area: Annotated[
        Texts, typer.Option(metavar="AREA", help="Cross-section at rest, such as 18mm2; or FILE=AREA (repeatable).")
    ] = None,
    gauge: Annotated[
        Texts, typer.Option(metavar="LENGTH", help="Length at rest, such as 33mm; or FILE=LENGTH (repeatable).")
    ] = None,
    only: Annotated[
        Texts, typer.Option(metavar="COLUMN=TEXT", help="Use the rows with this text in a column (repeatable).")
    ] = None,
    strains: Annotated[
        str | None, typer.Option("--range", metavar="LOW:HIGH", help="Use these strains alone: 0:2, or 0%:200%.")
    ] = None,
    unloading: Annotated[
        Unloading, typer.Option(help="Leave out unloading and reloading, or keep them.")
    ] = Unloading.cut,
    slack: Annotated[
        str, typer.Option(metavar="STRAIN", help="Strain at which the specimen is taut; 0 if there is no slack.")
    ] = "auto",
    compression: Annotated[
        bool | None,
        typer.Option(
            "--compression/--no-compression",
            help="Strain and stress of compression are written without minus; if not given, the files decide.",
        ),
    ] = None,
    relaxation: Annotated[
        bool | None,
        typer.Option("--relaxation/--no-relaxation", help="The strain is held; if not given, the data decide."),
    ] = None,
    law: Annotated[Texts, typer.Option(metavar="NAME", help="Fit this law alone (repeatable).")] = None,
    poissons_ratio: Annotated[float, typer.Option(help="Poisson's ratio of the material in a scene.")] = 0.4999,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder to write to; beside the first file, if not given."),
    ] = None,
    list_cards: Annotated[bool, typer.Option("--list", help="List the materials that cqrun has cards of.")] = False,
    card: Annotated[str | None, typer.Option(metavar="NAME", help="Print a card.")] = None,
    plugin: PluginFiles = None,
    quiet: Quiet = False,
) -> None:
    """Fit all elastic laws to tensile, planar, equibiaxial or relaxation tests, and write a material for scenes.

    Written are material.yaml (`material: {density: 1070, file: material.yaml}` in a scene), material.json and a figure.
    What a file does not say is asked for. `--list` and `--card` show materials that need no test.
    """
    if list_cards or card is not None:
        _show_cards(card)
        return
    if not files:
        raise UsageError("give the files of a test, or --list to see the materials that cqrun has cards of")
    from cqrun.cli.progress import reporting

    with reporting(quiet, f"reading {files[0]}") as reporter:
        from cqrun.jobs.material import make_material
        from cqrun.scene.plugin_files import load_plugin_files
        from cqrun.tensile import options
        from cqrun.tensile.curve import Given

        load_plugin_files(plugin or [])
        given = Given(
            columns=options.roles("--column", column or [], "strain=3"),
            units=options.units(unit or []),
            mode=options.by_file(mode or [], files, options.mode),
            area=options.by_file(area or [], files, options.area),
            gauge=options.by_file(gauge or [], files, options.gauge),
            only=options.pairs("--only", only or [], "material=A"),
            span=options.span(strains),
            unloading=unloading.value,
            slack=options.slack(slack),
            compression=compression,
            relaxation=relaxation,
        )
        tested = make_material(files, given, laws=law or (), ratio=poissons_ratio, out=out, reporter=reporter)
        reporter.phase("drawing")
        from cqrun.figures.material import draw_material
        from cqrun.figures.style import save, styled
        from cqrun.tensile.outputs import FIGURE, JSON, YAML

        with styled():
            pictures = save(draw_material(tested.material, tested.relaxations), tested.folder / FIGURE)
    for line in tested.lines():
        echo(line)
    for path in (tested.folder / YAML, tested.folder / JSON, *pictures):
        echo(f"written: {path}")


def _show_cards(name: str | None) -> None:
    from cqrun.scene.fragments import card_lines, card_text

    for line in card_lines() if name is None else card_text(name).splitlines():
        echo(line)
