"""Stopping on request."""

from __future__ import annotations

import os
import signal

import pytest

from cqrun.errors import Stopped
from cqrun.running.reporter import Silent, StopFlag


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_signal_sets_the_flag_once_and_its_exit_code(number, code):
    messages = []
    with StopFlag(messages.append) as flag:
        assert not flag.asked
        os.kill(os.getpid(), number)
        assert flag.asked
        assert len(messages) == 1
        error = flag.stopped("after iteration 3")
    assert (str(error), error.exit_code) == ("after iteration 3", code)
    assert Stopped.exit_code == 75, "the exit code of the class is unchanged"


def test_the_second_signal_aborts():
    with StopFlag() as flag:
        flag.ask()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)


def test_handlers_are_restored_after_an_error():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(ZeroDivisionError), StopFlag():
        raise ZeroDivisionError
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


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
