"""Centroids of a body's clusters: a body cut into pieces without naming them, as CQ2 does."""

from __future__ import annotations

from pydantic import Field

from cqrun.geometry.cluster import k_means
from cqrun.observers.matter import Matter
from cqrun.observers.motion import Motion, MotionObserver
from cqrun.plugin.registry import plugin


@plugin("observer", "clusters")
class Clusters(MotionObserver):
    """Position [m], velocity [m/s] and acceleration [m/s^2] of the centroids of clusters of a body.

    The body's particles at rest are cut into `count` clusters by k-means, once. Centroids are plain means, in the
    order of x at rest, then y, then z. The acceleration is as for `centroids`.
    """

    count: int = Field(description="How many clusters", ge=1)
    seed: int = Field(description="Seed of the clusters' first guess", ge=0, default=0)

    def bind(self, matter: Matter) -> Motion:
        members = matter.members(self.body)
        label = k_means(matter.x[members], self.count, self.seed)
        return self.motion([members[label == k] for k in range(self.count)], matter)
