"""The report in a real browser: on a phone and on a desktop nothing is cut off, broken, or reported as an error."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest

from cqrun.report.page import write_report
from cqrun.report.several import write_several

PROBE = """<title></title><iframe style="border: 0; width: {width}px; height: 900px"></iframe><script>
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => {{
  const page = frame.contentDocument, view = frame.contentWindow;
  page.querySelectorAll("details").forEach(part => part.open = true);
  const shown = element => element.getBoundingClientRect().width > 0;
  const texts = [...page.querySelectorAll("p, td, th, li, dd, dt, h1, h2, summary, figcaption")];
  document.title = JSON.stringify({{
    width: view.innerWidth,
    wide: page.documentElement.scrollWidth - view.innerWidth,
    pictures: page.images.length,
    broken: [...page.images].filter(image => !image.naturalWidth || !shown(image)).length,
    unnamed: [...page.images].filter(image => !image.alt.trim()).length,
    smallest: Math.min(...texts.map(text => parseFloat(view.getComputedStyle(text).fontSize))),
    faint: texts.filter(text => contrast(view, text) < 4.5).map(text => text.textContent.slice(0, 40)),
    headings: [...page.querySelectorAll("h1")].length,
  }});
}});
function contrast(view, element) {{
  let behind = element;
  const colour = part => view.getComputedStyle(part).backgroundColor;
  while (behind.parentElement && colour(behind) === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
  const light = text => {{
    const parts = text.match(/[0-9.]+/g).slice(0, 3).map(part => part / 255)
      .map(part => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
    return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
  }};
  const [low, high] = [light(view.getComputedStyle(element).color), light(colour(behind))].sort((a, b) => a - b);
  return (high + 0.05) / (low + 0.05);
}}
frame.src = "page.html";
</script>"""
"""A window of Chromium is no narrower than 500, so the page is shown in a frame, and measured from outside of it."""

pytestmark = pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's package chromium is absent")


def look_at(folder, width, *options):
    """Return what a browser measures of page.html in a folder, and what it prints to its console."""
    probe = folder / "probe.html"
    probe.write_text(PROBE.format(width=width))
    words = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", *options]
    words += ["--enable-logging=stderr", "--allow-file-access-from-files", "--dump-dom", "--virtual-time-budget=20000"]
    words += [f"--user-data-dir={folder / 'profile'}", probe.as_uri()]
    seen = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    (title,) = re.findall(r"<title>(\{.*?\})</title>", seen.stdout)
    return json.loads(title), [line for line in seen.stderr.splitlines() if "CONSOLE" in line]


def assert_readable(measured, console, width):
    assert console == []
    assert measured["width"] == width
    assert measured["wide"] <= 0
    assert measured["broken"] == 0
    assert measured["unnamed"] == 0
    assert measured["smallest"] >= 12
    assert measured["faint"] == []
    assert measured["headings"] == 1


@pytest.mark.parametrize("width", [390, 1280])
def test_a_report_of_each_kind_is_readable(each_run, tmp_path, width):
    write_report(each_run, tmp_path / "page.html")
    measured, console = look_at(tmp_path, width)
    assert_readable(measured, console, width)
    assert (measured["pictures"] > 0) == (not (each_run / "gradcheck.json").exists())


def test_a_report_is_readable_in_the_dark(made_runs, tmp_path):
    write_report(made_runs["sysid"], tmp_path / "page.html", pictures=False)
    assert_readable(*look_at(tmp_path, 390, "--blink-settings=preferredColorScheme=0"), 390)


def test_long_words_do_not_make_a_page_wide(copied, tmp_path):
    run = copied("simulate")
    result = json.loads((run / "result.json").read_text())
    result["findings"] = ["x" * 3000]
    result["bodies"] = {"y" * 300: next(iter(result["bodies"].values()))}
    (run / "result.json").write_text(json.dumps(result))
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | {"argv": ["cqrun", "z" * 3000], "engine": "w" * 3000}))
    write_report(run, tmp_path / "page.html", pictures=False)
    assert_readable(*look_at(tmp_path, 390), 390)


def test_a_page_of_several_runs_is_readable(made_runs, tmp_path):
    write_several([made_runs["sysid"], made_runs["simulate"]], tmp_path / "page.html", pictures=False)
    assert_readable(*look_at(tmp_path, 390), 390)


def test_an_error_in_a_page_would_be_seen(tmp_path):
    (tmp_path / "page.html").write_text('<h1>x</h1><script>throw new Error("broken")</script><img src="none.png">')
    measured, console = look_at(tmp_path, 390)
    assert console
    assert measured["broken"] == 1
