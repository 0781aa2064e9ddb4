"""Every command, scene, table and snippet of the documentation works as its page says."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
import yaml
from numba import config
from snippets import LANGUAGES, Block, blocks, commands, differences, pages

from cqrun.build.model import build
from cqrun.cli import app as cli
from cqrun.scene.load import load_scene
from docs.building.examples import with_on
from docs.building.present import present

SITE = Path(__file__).parents[2] / "docs" / "site"
PAGES = pages(SITE)
ids = [path.relative_to(SITE).as_posix() for path in PAGES]

whole_job = pytest.mark.skipif(bool(config.DISABLE_JIT), reason="a whole job takes minutes without the compiler")


@pytest.fixture
def run_page(tmp_path, monkeypatch, capsys) -> Callable[..., None]:
    """Return a function that does what a page says, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def do(page: Path, *, fast: bool) -> None:
        run, space = "", dict[str, object]()
        for block in blocks(present(page.read_text("utf-8"))):
            if "skip" in block.said:
                continue
            if block.file:
                Path(block.file).write_text(block.text, "utf-8")
                if block.language == "yaml":
                    build(load_scene(Path(block.file)))
            elif block.language == "yaml":
                _add(block)
            elif block.language == "python":
                exec(compile(block.text, str(page), "exec"), space)
            elif block.language == "console":
                run = _type(block, run, fast, capsys)

    return do


def _add(block: Block) -> None:
    """Load the scene that a part belongs to, with the part in it."""
    scene = Path(block.said["part of"])
    whole = with_on(yaml.safe_load(scene.read_text("utf-8")) | yaml.safe_load(block.text))
    changed = scene.with_name(f"with_part_{scene.name}")
    changed.write_text(yaml.safe_dump(whole, sort_keys=False), "utf-8")
    build(load_scene(changed))


def _type(block: Block, run: str, fast: bool, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the commands of a block; return the last run."""
    lines = list(commands(block.text))
    assert lines, f"a console block without a command: {block.text}"
    for command, output in lines:
        program, *words = shlex.split(command)
        assert program == "cqrun", f"mark this block with <!-- skip: why -->: {command}"
        words = [run if word == "RUN" else re.sub(r"^RUN/", f"{run}/", word) for word in words]
        shortened = fast and "fast" in block.said
        words += shlex.split(block.said["fast"]) if shortened else []
        with pytest.raises(SystemExit) as ended:
            cli.main([*words])
        printed, errors = capsys.readouterr()
        status = int(block.said.get("exit", 0)) if command == lines[-1][0] else 0
        assert int(ended.value.code or 0) == status, f"{command}\n{printed}{errors}"
        run = "".join(re.findall(r"^run: (.*)$", printed, re.MULTILINE)[-1:]) or run
        if output and not shortened:
            wrong = differences(output, printed + errors)
            assert not wrong, f"{command}\n{wrong}"
    return run


def test_every_block_says_what_it_is():
    for page in PAGES:
        for block in blocks(page.read_text("utf-8")):
            where = f"{page}: {block.text[:60]}"
            assert block.language in LANGUAGES, where
            if block.language in ("yaml", "csv"):
                assert block.file or {"part of", "skip"} & block.said.keys(), where


def test_commands_that_are_not_run_have_their_scenes_and_options():
    known = typer.main.get_command(cli.app).commands
    for page in PAGES:
        for block in blocks(present(page.read_text("utf-8"))):
            if block.language != "console" or "skip" not in block.said:
                continue
            for command, _ in commands(block.text):
                words = shlex.split(command.partition("||")[0])
                scenes = [word for word in words if word.startswith("scenes/")]
                assert all((SITE.parents[1] / scene).is_file() for scene in scenes), command
                if words[0] == "cqrun":
                    options = {option for parameter in known[words[1]].params for option in parameter.opts}
                    assert {word.partition("=")[0] for word in words if word.startswith("-")} <= options, command


@whole_job
@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_a_page_works(page, run_page):
    run_page(page, fast=True)


@whole_job
@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if "<!-- fast:" in p.read_text("utf-8")], ids=lambda p: p.stem)
def test_a_page_works_at_full_length(page, run_page):
    run_page(page, fast=False)


def test_outputs_are_compared():
    printed = "done: 0.5 s simulated\n\ntip.y  m  -0.0504\nrun: results/beam/0123456789ab\n"
    said = "done: 0.5 s simulated\n...\ntip.y m    -0.05041\nrun: results/beam/b3e5549f4800\n"
    assert not differences(said, printed)
    assert differences(said.replace("0.05041", "0.0555"), printed) == "-0.0555 is said to be printed, not -0.0504"
    assert differences(said.replace("tip.y", "tip.x"), printed).startswith("expected:")
    assert differences("simulated\n", "nothing\n").startswith("expected:")


def test_a_block_knows_what_stands_before_it():
    page = "Save it:\n\n`a.yaml`:\n\n```yaml\ncqrun: 1\n```\n\n"
    page += "<!-- fast: -o a=1 -->\n<!-- exit: 2 -->\n```console\n$ cqrun run\n```\n"
    scene, console = blocks(page)
    assert (scene.file, scene.said) == ("a.yaml", {})
    assert (console.file, console.said) == ("", {"fast": "-o a=1", "exit": "2"})
