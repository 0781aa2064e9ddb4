"""Stopping on request."""

from __future__ import annotations

import os
import signal

import pytest
from hangup import NOT_UNDER_NOHUP

from cqrun.errors import StopAsked, StopNow, Stopped
from cqrun.running.reporter import SIGNALS, Silent, StopFlag


@pytest.mark.parametrize(
    ("number", "code", "name"),
    [
        (signal.SIGINT, 130, "SIGINT (Ctrl-C)"),
        (signal.SIGTERM, 75, "SIGTERM"),
        pytest.param(signal.SIGHUP, 75, "SIGHUP (the terminal is gone)", marks=NOT_UNDER_NOHUP),
    ],
)
def test_a_deferred_signal_sets_the_flag_once_and_its_exit_code(number, code, name):
    messages = []
    with StopFlag(messages.append) as flag, flag.deferred():
        assert not flag.asked
        flag.check()
        os.kill(os.getpid(), number)
        assert flag.asked
        assert messages == ["stopping after the rollout at hand (once more: abort now)"]
        with pytest.raises(StopAsked):
            flag.check()
        error = flag.stopped("after iteration 3")
    assert (str(error), error.exit_code, flag.signum) == (f"{name}: after iteration 3", code, number)
    assert Stopped.exit_code == 75, "the exit code of the class is unchanged"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_where_nothing_asks_for_the_flag_a_signal_ends_the_work_at_once(number, code):
    messages = []
    with StopFlag(messages.append) as flag:
        with pytest.raises(StopNow):
            os.kill(os.getpid(), number)
        assert flag.exit_code == code
    with StopFlag(messages.append) as flag, flag.deferred(), flag.deferred(False), pytest.raises(StopNow):
        os.kill(os.getpid(), number)
    assert messages == []


def test_the_second_signal_aborts():
    with StopFlag() as flag, flag.deferred():
        flag.ask()
        with pytest.raises(StopNow, match="aborted"):
            os.kill(os.getpid(), signal.SIGTERM)


def test_a_request_without_a_signal_names_none():
    flag = StopFlag()
    flag.ask()
    assert (str(flag.stopped("after iteration 3")), flag.exit_code) == ("after iteration 3", 75)


def test_a_signal_that_is_ignored_stays_ignored_under_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopFlag() as flag:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not flag.asked
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_work_that_takes_long_does_not_begin_after_a_request_to_stop():
    flag = StopFlag()
    flag.ask()
    with flag.deferred(), pytest.raises(StopAsked), flag.deferred(False):
        raise AssertionError


def test_a_stream_that_is_written_to_when_the_signal_comes_loses_the_announcement_only():
    def announce(text):
        raise RuntimeError("reentrant call inside <_io.BufferedWriter name='<stderr>'>")

    with StopFlag(announce) as flag, flag.deferred():
        os.kill(os.getpid(), signal.SIGTERM)
        assert flag.asked


def test_handlers_are_restored_after_an_error():
    before = [signal.getsignal(number) for number in SIGNALS]
    with pytest.raises(ZeroDivisionError), StopFlag():
        raise ZeroDivisionError
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_the_silent_reporter_can_be_asked_to_stop(capsys):
    reporter = Silent()
    reporter.begin(3)
    reporter.phase("compiling")
    reporter.update(1, loss=1.0, best=1.0, step=0.1, seconds=0.1)
    reporter.warn("careful")
    assert capsys.readouterr() == ("", "")
    assert not reporter.stop.asked
    reporter.stop.ask(signal.SIGTERM)
    assert reporter.stop.asked
