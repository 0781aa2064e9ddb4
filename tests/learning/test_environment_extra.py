"""Without the extra `rl` an environment says which package is missing."""

from __future__ import annotations

import sys

import pytest

import cqrun
from cqrun.errors import MissingExtra


def test_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "cqrun.learning.environment", raising=False)
    with pytest.raises(MissingExtra, match=r"gymnasium, which is not installed: pip install 'cqrun\[rl\]'"):
        cqrun.environment("scenes/control/finger.yaml")
