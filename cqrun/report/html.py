"""Turn a page into HTML: one file that needs no other, no network and no scripts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from cqrun.characters import harmless
from cqrun.report.blocks import Page, pictures
from cqrun.report.images import images
from cqrun.store.atomic import write_text

if TYPE_CHECKING:
    from jinja2 import Template

LIMIT = 4_900_000
"""Size of a page, at most [bytes]: it can be sent by mail."""

LONGEST = 20_000
"""Letters of a text that is not code, at most."""

LONGEST_CODE = 100_000
"""Letters of a scene or another file in a page, at most."""

SPAN = re.compile("`([^`\n]+)`")

PAGE, STYLE = (Path(__file__).with_name(name) for name in ("page.html.j2", "page.css"))


def write_page(page: Page, path: Path) -> None:
    """Write a page, completely or not at all.

    Raises:
        UsageError: a picture cannot be read, or the file cannot be written. RunError: the disk is full.
    """
    write_text(path, html(page))


def html(page: Page) -> str:
    """Return a page as HTML; pictures get the room that its texts leave.

    Raises:
        UsageError: a picture cannot be read.
    """
    template = _template()
    style = STYLE.read_text(encoding="utf-8")
    bare = template.render(page=page, images={}, style=style)
    room = LIMIT - len(bare.encode(errors="backslashreplace"))
    shown = images([p for section in page.sections for p in pictures(section.blocks)], max(0, room))
    return template.render(page=page, images=shown, style=style)


def _template() -> Template:
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        autoescape=True, finalize=plain, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["code"] = code
    environment.filters["marked"] = marked
    environment.filters["css"] = Markup
    return environment.from_string(PAGE.read_text(encoding="utf-8"))


def plain(value: object) -> object:
    """Return what the template shows of a value: texts without characters that control what is around them."""
    if type(value) is not str:  # numbers, and marked text, which is escaped already
        return value
    return harmless(value) if len(value) <= LONGEST else f"{harmless(value[:LONGEST])} ..."


def marked(text: str) -> object:
    """Return a sentence in which what stands between backticks is code."""
    from markupsafe import Markup, escape

    return Markup(SPAN.sub(r"<code>\1</code>", str(escape(plain(text)))))


def code(text: str) -> object:
    """Return a text that is shown as it is, line by line."""
    from markupsafe import escape

    more = len(text) - LONGEST_CODE
    shown = harmless(text[:LONGEST_CODE].expandtabs())
    return escape(f"{shown}\n... and {more:,} more letters" if more > 0 else shown)
