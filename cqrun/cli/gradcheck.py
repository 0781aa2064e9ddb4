"""`cqrun gradcheck`: compare a scene's gradient with finite differences."""

from __future__ import annotations

import typer

from cqrun.cli.options import AllowPlugins, Fresh, Out, Overrides, Quiet, Scene, Threads
from cqrun.store.places import results_in


def gradcheck(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Compare a scene's gradient with finite differences for several step sizes; exit with 1 unless they agree."""
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_run

    out = results_in(out, scene)
    with working(quiet, allow_plugins, f"reading {scene}") as reporter:
        from cqrun.jobs.gradcheck import run_gradcheck

        run, agrees = run_gradcheck(scene, overrides or [], out, fresh=fresh, threads=threads, reporter=reporter)
    draw_and_print_run(run, quiet, allow_plugins)
    if not agrees:
        raise typer.Exit(1)
