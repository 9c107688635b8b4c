"""Likelihoods of a finger that is moved along a known path until it touches a part.

The distributions take the signed distance to the part (`bcppl.geometry.distance.SignedDistance`, or any
callable that maps points (..., 3) in the part's frame to something with `distance` and `normal`) as an
argument, or a `Placed` that evaluates it for a whole program at once. Scales are floats, or tensors (N,)
where they are latent.
"""

from bcppl.distributions.touch.direction import ForceDirection
from bcppl.distributions.touch.onset import FreePath, OnsetLocation
from bcppl.distributions.touch.path import Path
from bcppl.distributions.touch.placed import Placed
from bcppl.distributions.touch.shared_error import SharedError, SharedOnset

__all__ = [
    "ForceDirection",
    "FreePath",
    "OnsetLocation",
    "Path",
    "Placed",
    "SharedError",
    "SharedOnset",
]
