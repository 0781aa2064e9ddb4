"""Write the report that fits what is given: of one run, of several runs, or of a study."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from cqrun.errors import UsageError
from cqrun.report.page import write_report
from cqrun.report.several import write_several
from cqrun.report.study import is_study, study_in, write_study_page
from cqrun.store.atomic import make_directory

MOST_NAMES = 3
"""Names of scenes in the name of a page about several runs, at most."""


def write(
    paths: Sequence[Path], out: Path | None, folder: Path, *, pictures: bool = True, drawn: Sequence[Path] | None = None
) -> Path:
    """Write one page; return the file.

    Args:
        paths: one or more run directories; or one study: its file, or the folder that holds it.
        out: the file; if not given, report.html in the run, or a file beside the study or in `folder`.
        folder: where a page about several runs goes.
        pictures: whether the page has pictures.
        drawn: the pictures of a single run if they are drawn already.

    Raises:
        UsageError: a path is neither, or a file is damaged, or the page cannot be written.
        SceneError: this version cannot read a scene. RunError: the disk is full.
    """
    if out is not None:
        if out.suffix not in (".html", ".htm"):
            raise UsageError(f"-o {out}: a report is a web page: give a name that ends in .html")
        make_directory(out.parent)
    if len(paths) == 1 and is_study(paths[0]):
        return write_study_page(study_in(paths[0]), out, pictures=pictures)
    if len(paths) == 1:
        return write_report(paths[0], out, pictures=pictures, drawn=drawn)
    if studies := [path for path in paths if is_study(path)]:
        raise UsageError(f"{studies[0]}: is a study of several runs: give it alone, or give the folders of its runs")
    if out is None:
        make_directory(folder)
        out = folder / f"{_name(paths)}.html"
    return write_several(paths, out, pictures=pictures)


def _name(runs: Sequence[Path]) -> str:
    """Return the name of a page about several runs: the scenes, and hex digits that identify the runs."""
    places = [path.resolve() for path in runs]
    names = list(dict.fromkeys(place.parent.name for place in places))
    words = [*names[:MOST_NAMES], *(["others"] if len(names) > MOST_NAMES else [])]
    identity = "\n".join(sorted(f"{place.parent.name}/{place.name}" for place in places))
    digest = hashlib.sha256(identity.encode(errors="surrogateescape")).hexdigest()
    return f"report_{'_'.join(words)}_{digest[:8]}"
