"""Likelihoods of whole depth images of parts at their poses.

A pixel's density depends on its rendered depth: that of the part, or of the static background where that is
nearer or the ray misses the part; where the background is unknown, the density is uniform on the sensor's
range. Missing pixels (0, NaN, out of range) never count, and which are missing depends on the observation
only.
"""

from bcppl.distributions.depth.cluttered import ClutteredDepth
from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.noise import LaplaceDepth, RobustDepth
from bcppl.distributions.depth.observed import Observed

__all__ = [
    "ClutteredDepth",
    "DepthDistribution",
    "LaplaceDepth",
    "Observed",
    "RobustDepth",
]
