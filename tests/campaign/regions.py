"""The library's sets as plain arrays."""

import numpy as np

import reachjax as rj
from tests.campaign.oracle import Region


def plain(region: rj.AbstractSet) -> Region:
    """A set of the library as arrays."""
    if isinstance(region, rj.Intersection):
        facets, ball = plain(region.polytope), plain(region.ellipsoid)
        return Region(facets.A, facets.b, ball.center, ball.shape)
    if isinstance(region, rj.Ellipsoid):
        return Region(None, None, np.asarray(region.center), np.asarray(region.shape))
    A, b = region.facets
    return Region(np.asarray(A), np.asarray(b))


def finite(region: Region) -> bool:
    """Whether all its numbers are."""
    return all(v is None or np.isfinite(v).all() for v in vars(region).values())


def same(one: Region, other: Region) -> bool:
    """Whether two sets have the same numbers."""
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())
