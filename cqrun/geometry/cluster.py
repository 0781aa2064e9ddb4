"""One of the clusters that k-means finds in a body."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import complaint, finding
from cqrun.geometry.region import Points, Region
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName
from cqrun.plugin.registry import plugin

_ROUNDS = 100
"""Largest number of k-means iterations; a body's particles converge within a few dozen."""


@plugin("region", "cluster")
class Cluster(Region):
    """The particles of one k-means cluster of a body at rest, as CQ2 divides its robots.

    Clusters are sorted by their centroid's x, then y, then z, so an index means the same cluster whatever the order in
    which k-means found them.
    """

    of_particles: ClassVar[bool] = True

    count: int = Field(description="Number of clusters of the body", ge=1)
    index: int = Field(description="Index of the cluster, from 0", ge=0)
    seed: int = Field(description="Seed of the initial centroids", ge=0, default=0)
    body: BodyName | None = Field(description="Body that is divided; if absent, the body in which the region is used",
                             default=None)  # fmt: skip

    @model_validator(mode="after")
    def _has_the_index(self) -> Self:
        if self.index >= self.count:
            message = f"must be less than the count of {self.count}, is {self.index}: clusters count from 0"
            raise complaint(self.name, [finding(message, ("index",), involves=("count",))])
        return self

    def pick(self, points: Points) -> Array:
        if self.body not in (None, points.body):
            return np.zeros(len(points.x), bool)
        return k_means(points.x, self.count, self.seed) == self.index


def k_means(x: Array, count: int, seed: int) -> Array:
    """Return the cluster (N,) of every point (N, D): 0 has the centroid with the smallest x, then y, then z.

    Raises:
        UsageError: there are fewer points than clusters.
    """
    from scipy.cluster.vq import ClusterError, kmeans2

    places = len(np.unique(x, axis=0))
    if count > places:
        raise UsageError(f"{count} clusters of {places} particles: there can be at most one per particle")
    rng = np.random.default_rng(seed)
    try:
        centroids, labels = kmeans2(x, count, iter=_ROUNDS, minit="++", missing="raise", rng=rng)
    except ClusterError:
        raise UsageError(f"k-means leaves one of {count} clusters empty: ask for fewer, or give another seed") from None
    rank = np.empty(count, int)
    rank[np.lexsort(centroids.T[::-1])] = np.arange(count)
    return rank[labels]
