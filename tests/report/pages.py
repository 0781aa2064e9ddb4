"""Read a page as a browser does: what is open, what is shown, and what is fetched."""

from __future__ import annotations

from html.parser import HTMLParser

VOID = {"meta", "img", "source", "br", "link", "input", "hr"}
"""Elements without an end."""


class Read(HTMLParser):
    """What a page has.

    Attributes:
        problems: elements that are not closed, or closed without being open.
        tags: names of all elements.
        attributes: (element, attribute, value) of all attributes.
        text: the text that is shown.
    """

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.problems: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self._open: list[str] = []
        self._text: list[str] = []
        self.feed(page)
        self.close()
        self.problems += [f"<{tag}> is not closed" for tag in self._open]

    @property
    def text(self) -> str:
        """The text that is shown, with single spaces."""
        return " ".join("".join(self._text).split())

    def of(self, tag: str, attribute: str) -> list[str]:
        """Return the values of an attribute of all elements of a kind."""
        return [value for element, name, value in self.attributes if (element, name) == (tag, attribute)]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element."""
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """Compare the end of an element with the last one that is open."""
        if not self._open or self._open.pop() != tag:
            self.problems.append(f"</{tag}> at {self.getpos()}")
        if tag not in ("code", "a"):
            self._text.append(" ")

    def handle_data(self, data: str) -> None:
        """Keep text, but no style."""
        if self._open and self._open[-1] not in ("style", "script"):
            self._text.append(data)
