"""A mark for tests of SIGHUP, which `nohup` has processes ignore."""

from __future__ import annotations

import signal

import pytest

NOT_UNDER_NOHUP = pytest.mark.skipif(
    signal.getsignal(signal.SIGHUP) == signal.SIG_IGN, reason="SIGHUP is ignored, as under nohup"
)
