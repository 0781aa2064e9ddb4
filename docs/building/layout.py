"""The source of the site in a folder of its own: nothing is generated beside the pages that people write."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from docs.building.commands import command_pages
from docs.building.notebooks import notebook_page
from docs.building.present import present
from docs.building.reference import reference_pages

ROOT = Path(__file__).parents[2]
SITE = ROOT / "docs" / "site"

INCLUDED = {
    "docs/recordings.md": "formats/recordings.md",
    "docs/derivation.md": "theory/substep.md",
    "docs/convergence/README.md": "validation/convergence.md",
    "results/figures/README.md": "validation/papers.md",
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "ARCHITECTURE.md": "project/architecture.md",
    "README.md": "index.md",
    "docs/decisions/README.md": "decisions/index.md",
} | {f"docs/decisions/{path.name}": f"decisions/{path.name}" for path in (ROOT / "docs/decisions").glob("[0-9]*.md")}
"""Pages of the repository that are pages of the site, by path; README.md alone is only linked to."""

LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()#\s]+)(#[^()\s]*)?\)")
SOURCE = re.compile(r'src="([^":]+)"')
BLOCK = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"^<!-- (file|printed by|table of README.md): (.+) -->\n", re.MULTILINE)
"""What is filled in: a file, what `cqrun describe WORD` prints, or the table of README.md that begins so."""

FILES = "files"
LARGEST = 300_000


def lay_out(folder: Path) -> None:
    """Write the complete source of the site into a folder, which is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(SITE, folder)
    for path in sorted(folder.rglob("*.md")):
        name = path.relative_to(folder)
        text = MARK.sub(_filled_in, present(path.read_text("utf-8")))
        path.write_text(_with_links(text, SITE / name, name, folder), "utf-8")
    for path in sorted(folder.rglob("*.ipynb")):
        _write(path.with_suffix(".md"), notebook_page(path))
    for origin, place in INCLUDED.items():
        if origin != "README.md":
            text = (ROOT / origin).read_text("utf-8")
            _write(folder / place, _with_links(_adapted(text, place), ROOT / origin, Path(place), folder))
    for place, text in {**reference_pages(), **command_pages()}.items():
        _write(folder / place, text)


def _adapted(text: str, place: str) -> str:
    """Return a page of the repository as Sphinx reads it: anchors as targets, and a list of the pages of its folder."""
    text = re.sub(r'^(#+ )<a id="([\w-]+)"></a>', r"(\2)=\n\1", text, flags=re.MULTILINE)
    if place != "decisions/index.md":
        return text
    return text + "\n```{toctree}\n:hidden:\n:glob:\n\n[0-9]*\n```\n"


def _filled_in(mark: re.Match[str]) -> str:
    """Return what a mark stands for."""
    if mark[1] == "file":
        return f"```yaml\n{(ROOT / mark[2]).read_text('utf-8')}```\n"
    if mark[1] == "table of README.md":
        (table,) = re.findall(
            rf"^\| {mark[2]}.*?(?=^$)", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE | re.DOTALL
        )
        return str(table)
    from cqrun.cli.describe import _lines

    return "```text\n{}\n```\n".format("\n".join(_lines(mark[2].removeprefix("describe "), None)).rstrip())


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")


def _with_links(text: str, origin: Path, place: Path, folder: Path) -> str:
    """Return a page whose links to files of the repository lead to pages of the site, or to copies of the files."""

    def moved(link: re.Match[str]) -> str:
        picture, words, target, anchor = link[1], link[2], link[3], link[4] or ""
        words = SOURCE.sub(lambda m: f'src="{moved_to(m[1])}"', words)
        inner = LINK.sub(moved, words) if "](" in words else words
        new = moved_to(target)
        if new is None:  # a folder, or a file too large for the site
            return inner
        return f"{picture}[{inner}]({new}{anchor})"

    def moved_to(target: str) -> str | None:
        path = Path(os.path.normpath(origin.parent / target))
        if path.suffix == ".ipynb":  # it has a page of its own, which leads to the file
            return Path(target).with_suffix(".md").as_posix()
        if "://" in target or path.is_relative_to(SITE) or not path.is_relative_to(ROOT):
            return target
        name = path.relative_to(ROOT).as_posix()
        name = f"{name}/README.md" if f"{name}/README.md" in INCLUDED else name
        if name in INCLUDED:
            return Path(os.path.relpath(INCLUDED[name], place.parent)).as_posix()
        if not path.is_file() or path.stat().st_size > LARGEST:
            return None
        copy = folder / FILES / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
        return Path(os.path.relpath(copy, folder / place.parent)).as_posix()

    def prose(part: str) -> str:
        return SOURCE.sub(lambda m: f'src="{moved_to(m[1])}"', LINK.sub(moved, part))

    return "".join(part if part.startswith("```") else prose(part) for part in BLOCK.split(text))
