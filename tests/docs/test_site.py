"""The built documentation: no warning, no broken link, nothing from the network, a page for everything."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import yaml

from cqrun.build.model import build
from cqrun.cli.app import COMMANDS
from cqrun.cli.describe import _sections
from cqrun.plugin.registry import FOLDERS, plugins
from cqrun.scene.load import load_scene
from docs.building import examples
from docs.building.layout import INCLUDED
from docs.building.present import present

LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "video": "src"}
"""Attributes of elements that a browser loads with a page."""

SITE = Path(__file__).parents[2] / "docs" / "site"


class Page(HTMLParser):
    """The links, the loaded files and the anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links, self.loaded, self.anchors = set[str](), set[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors.update(values[key] for key in ("id", "name") if key in values)
        if tag == "a" and "href" in values:
            self.links.add(values["href"])
        if LOADED.get(tag) in values and values.get("rel") not in ("index", "search", "next", "prev", "canonical"):
            self.loaded.add(values[LOADED[tag]])


@pytest.fixture(scope="module")
def html(site) -> dict[Path, Page]:
    """Return all pages by their paths."""
    return {path: Page(path.read_text("utf-8")) for path in site.rglob("*.html")}


def places(html: dict[Path, Page]) -> Iterator[tuple[Path, str, Path, str]]:
    """Yield page, link, file and anchor of each link inside the site."""
    for path, page in html.items():
        for link in page.links | page.loaded:
            parts = urlsplit(link)
            if not parts.scheme and not parts.netloc:
                file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
                yield path, link, file, unquote(parts.fragment)


def test_no_link_is_broken(site, html):
    resolved = {path.resolve(): page for path, page in html.items()}
    found = [(path.relative_to(site), link, file, anchor) for path, link, file, anchor in places(html)]
    assert len(found) > 1000
    missing = [(path, link) for path, link, file, _ in found if not file.exists()]
    lost = [
        (path, link)
        for path, link, file, anchor in found
        if anchor and file.suffix == ".html" and file.resolve() in resolved
        and anchor not in resolved[file.resolve()].anchors
    ]  # fmt: skip
    assert not missing
    assert not lost


def test_a_page_loads_nothing_from_the_network(site, html):
    loaded = {(path.relative_to(site), link) for path, page in html.items() for link in page.loaded}
    assert not [place for place in loaded if re.match(r"(https?:)?//", place[1])]
    styles = "\n".join(path.read_text("utf-8") for path in site.rglob("*.css"))
    assert not re.findall(r"(?:url\(|@import\s+)['\"]?(?:https?:)?//[^)\s]+", styles)


def anchors(kind: str, names: Iterable[str]) -> set[str]:
    """Return the anchors of entries."""
    return {f"{kind}-{name}".replace("_", "-") for name in names}


def test_every_part_of_a_scene_and_every_command_has_an_entry(site, html):
    for kind in FOLDERS:
        names = [name for name, cls in plugins(kind).items() if cls.kind == kind]
        assert anchors(kind, names) <= html[site / f"reference/{kind}.html"].anchors
    assert anchors("section", _sections()) <= html[site / "reference/sections.html"].anchors
    assert anchors("command", [c.__name__ for c in COMMANDS]) <= html[site / "reference/commands.html"].anchors


def test_the_pages_of_the_repository_are_pages_of_the_site(site):
    assert all((site / place).with_suffix(".html").is_file() for place in INCLUDED.values())


def test_every_plug_in_has_an_example():
    missing = [
        f"{kind} {name}"
        for kind in FOLDERS
        for name, cls in plugins(kind).items()
        if cls.kind == kind and not examples.example(kind, name)
    ]
    assert not missing, "add it to docs/building/examples.yaml"


FIRST, *OTHERS = yaml.safe_load_all(examples.OWN.read_text("utf-8"))


@pytest.mark.parametrize("other", [{}, *OTHERS], ids=lambda other: "-".join(other.get("optimizer", ["all"])))
def test_the_examples_are_a_scene(other, tmp_path):
    path = tmp_path / "examples.yaml"
    path.write_text(yaml.safe_dump(examples.with_on(FIRST | other), sort_keys=False))
    assert build(load_scene(path)).model.n_controls == 10


def test_a_part_for_a_command_is_there_with_the_command():
    page = "a\n<!-- for cqrun {} -->\nb\n<!-- end -->\nc\n"
    assert present(page.format("simulate")) == "a\nb\nc\n"
    assert present(page.format("nonsense")) == "a\nc\n"


def gallery_items() -> list[tuple[str, str]]:
    """Return title and text of each picture of the gallery."""
    parts = re.split(r"^### (.+)$", (SITE / "gallery.md").read_text("utf-8"), flags=re.MULTILINE)[1:]
    texts = [re.split(r"^## ", text, flags=re.MULTILINE)[0] for text in parts[1::2]]
    return list(zip(parts[::2], texts, strict=True))


@pytest.mark.parametrize(("title", "text"), gallery_items(), ids=[title for title, _ in gallery_items()])
def test_a_picture_of_the_gallery_has_its_scene_and_its_commands(title, text):
    picture = re.search(r"^!\[.+\]\((.+)\)$", text, re.MULTILINE)
    scene = re.search(r"\[[Tt]he scene\]\(([^)#]+)[^)]*\)", text)
    command = re.search(r"^\$ cqrun \w+ (\S+\.yaml)", text, re.MULTILINE)
    assert picture is not None
    assert scene is not None
    assert command is not None
    assert (SITE / picture[1]).is_file()
    name = Path(command[1]).name
    source = (SITE / scene[1]).read_text("utf-8")
    assert Path(scene[1]).name == name or f"`{name}`:\n\n```yaml" in source
