"""What a depth camera measures of parts at their poses: likelihoods over whole depth images.

A pixel's density hangs on what is rendered there: the depth of the part, or of the static background where
that is nearer or the ray misses the part; where nothing is known to stand, the sensor's whole range. Missing
pixels (0, NaN, out of range) never count, and which are missing depends on the observation only.
"""

from bcppl.distributions.depth.cluttered import ClutteredDepth
from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.laplace import LaplaceDepth
from bcppl.distributions.depth.observed import Observed
from bcppl.distributions.depth.occluded import OccludedDepth
from bcppl.distributions.depth.rendering import PixelHits, RendersDepth
from bcppl.distributions.depth.robust import RobustDepth

__all__ = [
    "ClutteredDepth",
    "DepthDistribution",
    "LaplaceDepth",
    "Observed",
    "OccludedDepth",
    "PixelHits",
    "RendersDepth",
    "RobustDepth",
]
