"""Centroids of clusters that k-means finds in a body, as in CQ2."""

from __future__ import annotations

from pydantic import Field

from cqrun.geometry.cluster import k_means
from cqrun.observers.matter import Matter
from cqrun.observers.motion import Motion, MotionObserver
from cqrun.plugin.registry import plugin


@plugin("observer", "clusters")
class Clusters(MotionObserver):
    """Position [m], velocity [m/s] and acceleration [m/s^2] of the centroids of clusters of a body.

    k-means divides the body's particles at rest into `count` clusters, once. A centroid is the plain mean over its
    cluster. Clusters are sorted by their centroid's x at rest, then y, then z. For the acceleration see `centroids`.
    """

    count: int = Field(description="Number of clusters", ge=1)
    seed: int = Field(description="Seed of the initial centroids", ge=0, default=0)

    def bind(self, matter: Matter) -> Motion:
        members = matter.members(self.body)
        label = k_means(matter.x[members], self.count, self.seed)
        return self.motion([members[label == k] for k in range(self.count)], matter)
