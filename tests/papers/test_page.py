"""The page of all figures, and the README beside it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest
from test_publish import PUBLISHED, record_of
from toys import COUNT

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.machinery.page import _missing, _time, code, literal, write_page


def test_the_committed_gallery_is_of_the_committed_figures(tmp_path):
    """`python -m benchmarks.papers --page` was run after the last figure was published."""
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    write_page(FIGURES.values(), tmp_path / "figures")
    assert (tmp_path / "figures" / "README.md").read_text() == (PUBLISHED / "README.md").read_text()


def test_the_page_stands_alone(tmp_path):
    write_page(FIGURES.values(), tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert all(f'id="{figure.id}"' in page for figure in FIGURES.values())
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page)
    assert "Not run yet: <code>python -m benchmarks.papers --only cq1_table2</code>" in page


@pytest.mark.parametrize(
    ("done", "is_current", "text"),
    [
        ((1, 2), True, "1 of 2 tasks are done"),
        ((1, 2), False, "1 of 2 tasks are done; the tasks have changed since"),
        ((2, 2), False, "the tasks have changed since"),
        ((2, 2), True, ""),
    ],
)
def test_the_page_says_what_is_missing(done, is_current, text):
    record = record_of(COUNT)
    record.done = done
    assert _missing(record, is_current) == text


def test_the_page_says_what_a_task_remarks():
    record = record_of(COUNT)
    assert _time(record) == "60 s"
    record.tasks["count"].remark = "by heart"
    assert _time(record) == "60 s (count: by heart)"


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's package chromium is absent")
def test_the_page_in_a_browser(tmp_path, width):
    """Every picture is loaded, and nothing is wider than the window or than where it stands."""
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    write_page(FIGURES.values(), tmp_path / "figures")
    page = (tmp_path / "figures" / "index.html").read_text()
    script = """<script>addEventListener("load", () => {
      const shown = i => i.naturalWidth > 0 && i.getBoundingClientRect().width > 0;
      parent.document.title = JSON.stringify({width: innerWidth,
        broken: [...document.images].filter(i => !shown(i)).length,
        wide: document.documentElement.scrollWidth - innerWidth,
        cut: [...document.querySelectorAll(".scroll")].map(box => box.scrollWidth - box.clientWidth),
        sections: document.querySelectorAll("section").length}) })</script>"""
    (tmp_path / "page.html").write_text(page.replace(' loading="lazy"', "").replace("</body>", script + "</body>"))
    probe = tmp_path / "probe.html"  # a window of Chromium's own is no narrower than 500
    probe.write_text(f'<title></title><iframe src="page.html" style="border: 0; width: {width}px; height: 900px">')
    words = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    words += ["--allow-file-access-from-files", "--dump-dom", "--virtual-time-budget=20000"]
    words += [f"--user-data-dir={tmp_path / 'profile'}", probe.as_uri()]
    seen = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True).stdout
    (title,) = re.findall(r"<title>(\{.*?\})</title>", seen)
    measured = json.loads(title)
    assert measured["width"] == width
    assert measured["broken"] == 0
    assert measured["wide"] <= 0
    assert max(measured["cut"]) <= 0
    assert measured["sections"] == len(FIGURES)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a *b* _c_ d_e [f](g) <h> `i` | j \\ $k$", r"a \*b\* \_c\_ d_e \[f\](g) \<h> \`i\` \| j \\ \$k\$"),
        ("two\nlines", "two lines"),
        ("# heading", r"\# heading"),
        ("- item", r"\- item"),
        ("1. item", r"1\. item"),
        ("---", r"\---"),
        ("-0.02 -> 0.77 m, 1.5", "-0.02 -> 0.77 m, 1.5"),
    ],
)
def test_the_gallery_shows_texts_literally_as_the_page_does(text, shown):
    assert literal(text) == shown


@pytest.mark.parametrize(
    ("text", "shown"), [("cqrun a_b", "`cqrun a_b`"), ("a `b`\nc", "``a `b` c``"), ("`a", "`` `a ``")]
)
def test_the_gallery_shows_commands_as_code(text, shown):
    assert literal(code(text)) == shown
