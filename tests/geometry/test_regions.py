"""Regions: selected points, cluster indices that do not depend on the seed, and errors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from cqrun.errors import UsageError
from cqrun.geometry.cluster import k_means
from cqrun.geometry.region import ChosenRegion, Region
from cqrun.plugin.registry import plugins

ADAPTER: TypeAdapter[Any] = TypeAdapter(ChosenRegion)
LEFT = {"half_space": {"point": [0, 0], "normal": [1, 0]}}
LOW = {"half_space": {"point": [0, 0], "normal": [0, 1]}}


@dataclass
class Points:
    """Points with names and colours."""

    x: np.ndarray
    body: str | None = "b"
    masks: dict[str, np.ndarray] = field(default_factory=dict)

    def named(self, name: str) -> np.ndarray:
        return self.masks[name]

    def coloured(self, colour: str) -> np.ndarray:
        return self.masks[colour]


CORNERS = Points(np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]), masks={"first": np.arange(4) == 0})


def region(data: Any) -> Region:
    value: Region = ADAPTER.validate_python(data).value
    return value


@pytest.mark.parametrize(
    ("data", "picked"),
    [
        (LEFT, [0, 2]),
        ("first", [0]),
        ({"named": "first"}, [0]),
        ({"union": ["first", LEFT]}, [0, 2]),
        ({"difference": [LEFT, "first"]}, [2]),
        ({"difference": [LEFT, "first", LOW]}, [2]),
        ({"intersection": [LEFT, LOW, "first"]}, [0]),
        ({"union": [{"difference": [LEFT, LOW]}, {"intersection": [LEFT, LOW]}]}, [0, 2]),
        ({"colour": "first"}, [0]),
        ({"nearest_marker": {"markers": {"a": [-2, 0], "b": [3, 0]}, "marker": "b"}}, [1, 3]),
        # a tie goes to the marker that is named first
        ({"nearest_marker": {"markers": {"a": [0, 2], "b": [0, -2], "c": [0, 2]}, "marker": "c"}}, []),
        ({"nearest_marker": {"markers": {"a": [0, 2], "b": [0, -2], "c": [0, 2]}, "marker": "a"}}, [2, 3]),
    ],
)
def test_region_selects_points(data: Any, picked: list[int]) -> None:
    mask = region(data).pick(CORNERS)
    assert mask.dtype == bool
    assert np.flatnonzero(mask).tolist() == picked


def test_every_shape_is_a_region_and_names_survive_a_dump() -> None:
    assert plugins("region").keys() >= plugins("shape").keys()
    assert plugins("region")["union"] is not plugins("shape")["union"]
    chosen = ADAPTER.validate_python({"union": ["first", LEFT]})
    again = ADAPTER.validate_python(ADAPTER.dump_python(chosen))
    assert again == chosen


def clouds(rng: np.random.Generator) -> np.ndarray:
    centres = np.array([[0.0, 5.0], [0.0, 0.0], [5.0, 0.0]])
    return rng.permutation(np.concatenate([centre + 0.1 * rng.normal(size=(40, 2)) for centre in centres]))


def test_clusters_are_sorted_by_x_then_y(rng: np.random.Generator) -> None:
    x = clouds(rng)
    x[:, 0] = np.round(x[:, 0])  # two centroids with the very same x
    x[np.abs(x[:, 0]) < 1, 0] = 0.0
    labels = k_means(x, 3, 0)
    assert (labels[(x[:, 0] == 0) & (x[:, 1] < 2)] == 0).all()
    assert (labels[(x[:, 0] == 0) & (x[:, 1] > 2)] == 1).all()
    assert (labels[x[:, 0] > 2] == 2).all()
    assert all((k_means(x, 3, seed) == labels).all() for seed in range(1, 6))


def test_cluster_is_deterministic_and_belongs_to_its_body(rng: np.random.Generator) -> None:
    x = rng.uniform(size=(500, 3))
    assert (k_means(x, 7, 3) == k_means(x, 7, 3)).all()
    assert sorted(set(k_means(x, 7, 3))) == list(range(7))
    parts = [region({"cluster": {"count": 7, "index": k}}).pick(Points(x)) for k in range(7)]
    assert (np.sum(parts, axis=0) == 1).all()
    other = region({"cluster": {"count": 7, "index": 0, "body": "c"}})
    assert not other.pick(Points(x)).any()
    assert (other.pick(Points(x, body="c")) == parts[0]).all()


def test_more_clusters_than_particles_are_an_error() -> None:
    with pytest.raises(UsageError, match="5 clusters of 4 particles: there can be at most one per particle"):
        region({"cluster": {"count": 5, "index": 0}}).pick(CORNERS)
    with pytest.raises(UsageError, match="2 clusters of 1 particles"):
        region({"cluster": {"count": 2, "index": 0}}).pick(Points(np.zeros((9, 2))))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"cluster": {"count": 3, "index": 3}}, "must be less than the count of 3, is 3"),
        ({"cluster": {"count": 0, "index": 0}}, "must be at least 1, is 0"),
        (
            {"nearest_marker": {"markers": {"tip": [0, 0], "base": [1, 0]}, "marker": "tap"}},
            "there is no marker 'tap' (did you mean 'tip'?); there are: tip, base",
        ),
        ({"nearest_marker": {"markers": {"tip": [0, 0]}, "marker": "tip"}}, "at least 2 entries, has 1"),
        ({"difference": ["first"]}, "at least 2 entries, has 1"),
        ({"bal": {}}, "no region has this name (did you mean 'ball'?)"),
        (3, "must be a mapping `name: {...}` with one of ball, box"),
    ],
)
def test_invalid_region_is_an_error(data: Any, message: str) -> None:
    with pytest.raises(ValidationError) as info:
        region(data)
    assert message in str(info.value)


def test_markers_must_have_the_dimension_of_the_world() -> None:
    nearest = region({"nearest_marker": {"markers": {"a": [0, 0], "b": [1, 0, 0]}, "marker": "a"}})
    assert nearest.dim_problems(2) == [(("markers", "b"), "must have 2 entries in this 2D world, has 3")]
