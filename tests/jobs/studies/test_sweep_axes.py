"""The axes of a sweep as typed, and the points that they span."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.jobs.studies.axes import axis_of, points_of
from cqrun.scene.document import read

VALUES = {
    "k=a,b,c": ["a", "b", "c"],
    "k=1e4, 2.5": [1e4, 2.5],
    "k=[0, 1],[1, 0]": [[0, 1], [1, 0]],
    "k='a,b',c": ["a,b", "c"],
    "k={box: {size: [1, 2]}},null": [{"box": {"size": [1, 2]}}, None],
    "k=7": [7],
    "k=0.1:0.5:5": [0.1, 0.2, 0.3, 0.4, 0.5],
    "k=-1:1:3": [-1, 0, 1],
    "k=5:1:3": [5, 3, 1],
    "k=1e4:1e6:log:3": [10_000, 100_000, 1_000_000],
}


@pytest.mark.parametrize("text", VALUES)
def test_values(text):
    axis = axis_of(text)
    assert axis.path == "k"
    assert [read(value).data for value in axis.values] == VALUES[text]


WRONG = {
    "k": "must be key=a,b,c",
    "=1,2": "must be key=a,b,c",
    "k=": "must be key=a,b,c",
    "k=1,,2": "has an empty value",
    "k=1,2,1": "has a value twice",
    "k=1:1:3": "its two ends are equal",
    "k=0:1:log:3": "positive ends",
    "k=1:2:1": "2 to 10,000 values, this one has 1",
    "k=1:2:20000": "this one has 20000",
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_axis_is_refused_with_the_text(text):
    with pytest.raises(UsageError, match=WRONG[text]) as raised:
        axis_of(text)
    assert str(raised.value).startswith(f"-s {text}: ")


def test_lists_are_combined_and_the_first_changes_slowest():
    points = points_of([axis_of("a=1,2"), axis_of("b=x,y,z")], None)
    assert [(p["a"], p["b"]) for p in points] == [(a, b) for a in "12" for b in "xyz"]


def test_a_latin_hypercube_has_one_sample_in_every_stripe():
    points = points_of([axis_of("a=0:1"), axis_of("b=1:1e4:log"), axis_of("c=p,q")], 8)
    assert len(points) == 16
    first, second = ([p for p in points if p["c"] == c] for c in "pq")
    assert [p | {"c": ""} for p in first] == [p | {"c": ""} for p in second]
    a, b = (np.array([float(p[k]) for p in first]) for k in "ab")
    assert sorted(np.floor(8 * a)) == sorted(np.floor(8 * np.log10(b) / 4)) == list(range(8))


@pytest.mark.parametrize("sampling", ["latin", "random"])
def test_samples_depend_on_the_seed_alone(sampling):
    ranges = [axis_of("a=2:3"), axis_of("b=-5:-1")]
    first, again, other = (points_of(ranges, 5, sampling, seed) for seed in (0, 0, 1))
    assert first == again != other
    assert all(2 <= float(p["a"]) <= 3 and -5 <= float(p["b"]) <= -1 for p in (*first, *other))


@pytest.mark.parametrize(
    ("texts", "samples", "message"),
    [
        ([], None, "a sweep needs an axis"),
        (["a=1,2", "a=3"], None, "-s a=...: is given twice"),
        (["a=1:2"], None, "-s a: a range without a count is sampled"),
        (["a=1,2"], 3, "--samples 3: there is no range to sample"),
        (["a=1:2:200", "b=1:2:200"], None, "this one would have 40,000"),
    ],
)
def test_axes_that_do_not_fit_together_are_refused(texts, samples, message):
    with pytest.raises(UsageError, match=message):
        points_of([axis_of(text) for text in texts], samples)
