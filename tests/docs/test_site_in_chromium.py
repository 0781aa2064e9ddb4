"""The built documentation in a real browser, from disk and without a network, as wide as a phone."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest

PROBE = """<title></title><iframe style="border: 0; width: {width}px; height: 900px"></iframe><script>
const frame = document.querySelector("iframe"), pages = {pages}, seen = {{}};
let at = 0;
frame.addEventListener("load", () => {{
  const page = frame.contentDocument, view = frame.contentWindow;
  const shown = element => element.getBoundingClientRect().width > 0;
  page.querySelectorAll("img").forEach(image => image.loading = "eager");
  seen[pages[at]] = {{
    width: view.innerWidth,
    wide: page.documentElement.scrollWidth - view.innerWidth,
    headings: page.querySelectorAll("h1").length,
    equations: [...page.querySelectorAll("math")].filter(shown).length,
    broken: [...page.images].filter(image => image.complete && !image.naturalWidth).length,
    unnamed: [...page.images].filter(image => !image.alt.trim()).length,
  }};
  at += 1;
  if (at < pages.length) frame.src = pages[at];
  else document.title = JSON.stringify(seen);
}});
frame.src = pages[0];
</script>"""
"""A window of Chromium is no narrower than 500, so the pages are shown in a frame, and measured from outside of it."""

MADE_BY_SPHINX = ("search.html", "genindex.html")

pytestmark = pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's package chromium is absent")


@pytest.mark.parametrize("width", [390, 1280])
def test_every_page_fits_and_has_no_error(site, width):
    pages = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html") if path.name != "probe.html")
    pages = [page for page in pages if page not in MADE_BY_SPHINX]
    probe = site / "probe.html"
    probe.write_text(PROBE.format(width=width, pages=json.dumps(pages)))
    words = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    words += ["--enable-logging=stderr", "--allow-file-access-from-files", "--dump-dom", "--virtual-time-budget=60000"]
    words += [f"--user-data-dir={site / 'profile'}", "--host-resolver-rules=MAP * ~NOTFOUND", probe.as_uri()]
    seen = subprocess.run(words, capture_output=True, text=True, timeout=170, check=True)
    (title,) = re.findall(r"<title>(\{.*?\})</title>", seen.stdout)
    measured = json.loads(title)
    assert not [line for line in seen.stderr.splitlines() if "CONSOLE" in line]
    assert measured.keys() == set(pages)
    for page, facts in measured.items():
        assert facts["width"] == width, page
        assert facts["wide"] <= 0, page
        assert facts["headings"] == 1, page
        assert (facts["broken"], facts["unnamed"]) == (0, 0), page
    assert measured["theory/index.html"]["equations"] > 20
