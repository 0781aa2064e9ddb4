"""Progress: plain lines for log files, one live line on a terminal, quiet mode, and signals."""

from __future__ import annotations

import io
import os
import re
import signal
import time
from pathlib import Path

import pytest

from cqrun.cli.progress import BRIEF, Progress, clock, reporting
from cqrun.cli.results import print_run
from cqrun.errors import Stopped


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch):
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def use(stream: io.StringIO, **options: object) -> str:
    """Return what a job of three iterations writes."""
    with Progress(stream=stream, **options) as progress:
        progress.begin(3)
        progress.phase("compiling kernels")
        for k in (1, 2, 3):
            progress.update(k, loss=1.0 / k, best=1.0 / k, step=0.5, seconds=40.0)
        progress.warn("the step is [large]")
    return stream.getvalue()


def untimed(text: str) -> list[str]:
    """Return the lines of a log without their times of day, which all but warnings have."""
    lines = text.splitlines()
    assert all(re.match(r"\d\d:\d\d:\d\d  \S|warning: ", line) for line in lines)
    return [re.sub(r"^\d\d:\d\d:\d\d  ", "", line) for line in lines]


def test_a_log_file_gets_plain_lines():
    first, second, third, fourth, warning = untimed(use(io.StringIO(), plain_every=0.0))
    assert first == "compiling kernels"
    assert second == "iteration 1/3  loss 1  best 1  step 0.5  40 s/iteration  1:20 left"
    assert third.startswith("iteration 2/3  loss 0.5")
    assert fourth.endswith("0 s left")
    assert warning == "warning: the step is [large]"


def test_the_place_of_a_warning_is_printed_unchanged():
    """`:100:` is the name of an emoji."""
    stream = io.StringIO()
    with Progress(stream=stream) as progress:
        progress.warn("long.yaml:100:53: no such group")
    assert stream.getvalue() == "warning: long.yaml:100:53: no such group\n"


def test_a_log_file_has_few_lines_but_always_the_last_iteration():
    stream = io.StringIO()
    with Progress(stream=stream, plain_every=1e9) as progress:
        for k in range(1, 101):
            progress.update(k, loss=1.0, best=1.0, step=0.0, seconds=0.0)
    lines = untimed(stream.getvalue())
    assert [line.split()[1] for line in lines] == ["1", "100"]


def test_work_with_a_known_end_shows_the_remaining_time(monkeypatch):
    from cqrun.cli import progress as module

    now = iter([0.0, 10.0, 30.0, 30.0])
    stream = io.StringIO()
    with Progress(stream=stream, plain_every=0.0) as progress:
        progress.phase("simulating")
        for done in (0, 1, 3):
            moment = next(now)
            monkeypatch.setattr(module.time, "monotonic", lambda moment=moment: moment)
            progress.advance(done, 9, f"t = {done} of 9 s")
    assert untimed(stream.getvalue()) == [
        "simulating", "t = 0 of 9 s", "t = 1 of 9 s  1:20 left", "t = 3 of 9 s  1:00 left",
    ]  # fmt: skip


def test_the_last_numbers_of_a_phase_are_not_lost():
    stream = io.StringIO()
    with Progress(stream=stream, plain_every=1e9) as progress:
        for done in range(4):
            progress.advance(done, 3, f"{done} of 3")
        progress.warn("careful")
        progress.phase("then")
    lines = [line.partition("  ")[0] for line in untimed(stream.getvalue())]
    assert lines == ["0 of 3", "warning: careful", "3 of 3", "then"]


def test_line_feed_in_a_files_name_makes_no_second_line(capsys, monkeypatch):
    stream = io.StringIO()
    with Progress(stream=stream) as progress:
        progress.phase("reading a\nerror: b.yaml")
    assert untimed(stream.getvalue()) == ["reading a\\nerror: b.yaml"]
    monkeypatch.setattr("cqrun.jobs.table.report_lines", lambda run: [])
    print_run(Path("results/a\nerror: b/0123456789ab"), allow_plugins=False)
    assert capsys.readouterr().out == "run: results/a\\nerror: b/0123456789ab\n"


def test_quiet_keeps_warnings():
    assert use(io.StringIO(), quiet=True) == "warning: the step is [large]\n"
    assert use(Terminal(), quiet=True).count("\n") == 1


def test_a_terminal_gets_a_live_line_that_is_erased_at_the_end():
    text = use(Terminal())
    assert "iteration 3/3" in text
    assert "\x1b[?25l" in text  # the cursor is hidden while the line is live
    assert text.rstrip().endswith("\x1b[2K")  # and the line is erased


def test_a_terminal_that_cannot_move_its_cursor_gets_plain_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    text = use(Terminal(), plain_every=0.0)
    assert "\x1b[?25l" not in text
    assert text.count("iteration") == 3 + 3  # three lines, each with s/iteration


def test_no_color_is_respected(monkeypatch):
    assert "\x1b[33m" in use(Terminal())
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[33m" not in use(Terminal())


def test_no_silence_is_long(monkeypatch):
    """Whatever the work does, and however long it does it."""
    stream = io.StringIO()
    with Progress(stream=stream, silent_at_most=0.2) as progress:
        progress.phase("compiling kernels")
        time.sleep(0.7)
        progress.phase("fitting")
        progress.update(1, loss=1.0, best=1.0, step=0.5, seconds=40.0)
        time.sleep(0.35)
    lines = untimed(stream.getvalue())
    assert lines[0] == "compiling kernels"
    assert lines.count("still compiling kernels: 0 s so far") + lines.count("still compiling kernels: 1 s so far") >= 2
    (again, *_) = (line for line in lines if line.startswith("still fitting: 0 s so far; last: iteration 1  loss 1"))
    assert lines.index(again) > lines.index("fitting")


def test_the_first_phase_is_printed_if_it_lasts(monkeypatch):
    """It is what is done while libraries are imported and the scene is read."""
    monkeypatch.setattr("cqrun.cli.progress.BRIEF", 0.2)
    for lasts, expected in ((0.0, ["then"]), (0.6, ["reading beam.yaml", "then"])):
        stream = io.StringIO()
        with Progress(stream=stream, doing="reading beam.yaml") as progress:
            time.sleep(lasts)
            progress.phase("then")
        assert untimed(stream.getvalue()) == expected
    assert BRIEF <= 1.0  # with the interval of the check, that is two seconds at most


def test_quiet_and_live_progress_are_not_interrupted_by_lines():
    for stream, quiet in ((io.StringIO(), True), (Terminal(), False)):
        with Progress(stream=stream, quiet=quiet, silent_at_most=0.05) as progress:
            progress.phase("compiling")
            time.sleep(0.3)
        assert "still" not in stream.getvalue()


def test_a_live_line_shows_the_time_of_work_without_numbers_from_the_start():
    stream = Terminal()
    with Progress(stream=stream) as progress:
        progress.phase("compiling kernels")
        time.sleep(0.4)
    assert "[0 s]  compiling kernels" in stream.getvalue()


@pytest.mark.parametrize("columns", [60, 200])
def test_a_live_line_shows_elapsed_and_remaining_time_and_numbers_in_a_narrow_window(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = Terminal()
    phase = "simulating 240,000 particles, 1,400 substeps, less than an hour in all on one core"
    with Progress(stream=stream) as progress:
        progress.phase(phase)
        progress.advance(0, 9, "t = 0 of 9 s")
        time.sleep(0.2)
        progress.advance(1, 9, "t = 1 of 9 s")
        time.sleep(0.3)
    text = stream.getvalue()
    assert "[0 s, 2 s left]  t = 1 of 9 s  simulating" in text
    assert (phase in text) == (columns == 200)
    lines = re.split(r"\x1b\[[0-9;?]*[A-Za-z]|[\r\n]", text)
    assert max(map(len, lines)) <= columns


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_the_first_signal_asks_to_stop_and_the_second_aborts(capsys, number, code):
    before = signal.getsignal(number)

    def job() -> None:
        with reporting(quiet=True) as reporter, reporter.stop.deferred():
            assert not reporter.stop.asked
            os.kill(os.getpid(), number)
            assert reporter.stop.asked
            assert "stopping after the rollout at hand (once more: abort now)" in capsys.readouterr().err
            os.kill(os.getpid(), number)

    with pytest.raises(Stopped, match="aborted") as ended:
        job()
    assert ended.value.exit_code == code
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1:00"), (187, "3:07"), (3729, "1:02:09")]
)
def test_clock(seconds, text):
    assert clock(seconds) == text
