"""Everything that the documents mention exists: commands, make targets, exit codes, links."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from cqrun.build.model import build
from cqrun.cli.app import COMMANDS
from cqrun.errors import RunError, Stopped, UsageError
from cqrun.running.reporter import EXIT_INTERRUPTED
from cqrun.scene.load import load_scene
from cqrun.store.places import DEFAULT_OUT
from docs.building.present import present

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
README = (ROOT / "README.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()
NAMES = {command.__name__ for command in COMMANDS}
TARGETS = set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))


def test_the_readme_lists_every_command():
    assert set(re.findall(r"^\| `cqrun (\w+)", README, re.MULTILINE)) == NAMES


FENCED = re.compile(r"^```\w*\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def code_of(text: str) -> str:
    """Return the code of a page: fenced blocks, then what stands between backticks, then indented lines."""
    rest = FENCED.sub("", text)
    indented = re.findall(r"^    (.*)$", rest, re.MULTILINE)
    return "\n".join([*FENCED.findall(text), *re.findall(r"`([^`]+)`", rest), *indented])


def test_code_is_told_from_prose():
    page = "Say `cqrun a`, or\n\n```yaml\ncqrun: 1\n```\n\nthen cqrun does `b`.\n\n    cqrun c\n"
    assert code_of(page).split("\n") == ["cqrun: 1", "", "cqrun a", "b", "cqrun c"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_and_links_of_a_page_exist(page):
    text = present(page.read_text())
    code = code_of(text)
    assert set(re.findall(r"\bcqrun ([a-z]+)\b", code)) <= NAMES
    assert set(re.findall(r"\bmake ([a-z-]+)\b", code)) <= TARGETS
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing


def test_make_help_lists_every_target():
    command = ["make", "--no-print-directory", "help"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert set(re.findall(r"^  make ([a-z-]+) ", listing, re.MULTILINE)) == TARGETS
    assert all(re.search(rf"^{t}:.*## \w", MAKEFILE, re.MULTILINE) for t in TARGETS)


def test_the_readme_has_the_exit_codes():
    table = [int(code) for code in re.findall(r"^\| (\d+) \|", README, re.MULTILINE)]
    real = [0, RunError.exit_code, UsageError.exit_code, Stopped.exit_code, EXIT_INTERRUPTED]
    assert table == real


def test_the_readme_has_the_default_results_folder():
    assert f"`--out DIR` (default: `{DEFAULT_OUT}/` beside the scene" in README


def test_the_readme_shows_a_scene_that_can_be_run():
    text, *_ = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    built = build(load_scene(text))
    assert not built.warnings
    assert built.model.n_controls == 100


def test_the_demo_runs_a_shipped_scene():
    demo = re.search(r"^DEMO := (.+)$", MAKEFILE, re.MULTILINE)
    assert demo
    assert (ROOT / demo[1]).is_file()
    assert demo[1] in README


def test_the_changelog_has_this_version():
    from cqrun import __version__

    assert f"\n## {__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_citation_has_this_version_and_the_papers_of_the_report():
    import yaml

    from cqrun import __version__
    from cqrun.report.cite import PAPERS

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    for paper in citation["references"]:
        assert f"{{{paper['doi']}}}" in PAPERS
        assert all(author["family-names"] in PAPERS for author in paper["authors"])
