"""The notebooks of the documentation run, and print what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from numba import config
from snippets import differences

from docs.building.notebooks import executed, notebook_page

SITE = Path(__file__).parents[2] / "docs" / "site"
NOTEBOOKS = sorted(SITE.rglob("*.ipynb"))

pytestmark = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="a notebook takes minutes without the compiler")
def test_a_notebook_prints_what_it_says(path):
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("nbclient")
    kept, again = nbformat.read(path, as_version=4), executed(path)
    assert any(cell.get("outputs") for cell in kept.cells), "run it: python -m docs.building.notebooks FILE"
    for before, after in zip(kept.cells, again.cells, strict=True):
        for said, printed in zip(before.get("outputs", []), after.get("outputs", []), strict=True):
            assert not differences(_words(said), _words(printed)), before.source
            assert said.get("data", {}).keys() == printed.get("data", {}).keys()


def test_a_notebook_is_a_page_with_its_pictures(path, tmp_path):
    copy = tmp_path / path.name
    copy.write_bytes(path.read_bytes())
    page = notebook_page(copy)
    pictures = re.findall(r"!\[(.+?)\]\((\S+)\)", page)
    assert pictures, "a picture without an alternative text, or no picture"
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for _, name in pictures)
    assert page.count("```") % 2 == 0


def _words(output) -> str:
    """Return what an output of a cell says in words."""
    return output.get("text") or output.get("data", {}).get("text/plain", "")
