"""`cqrun warmup`: compile the kernels before they are needed."""

from __future__ import annotations

from cqrun.cli.options import Quiet


def warmup(quiet: Quiet = False) -> None:
    """Compile the kernels into the cache, so that the next run starts at once."""
    from cqrun.cli.progress import reporting

    with reporting(quiet) as progress:
        progress.phase("compiling kernels (once for this version and machine)")
        from cqrun.jobs.warmup import warmup as compile_kernels

        compile_kernels()
