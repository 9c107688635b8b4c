"""Priors and proposals over poses on SE(3), all with respect to one base measure (see `bcppl.poses`).

The attribute `freedom` of each is its free axes; the others are held at the values of its centre.
"""

from bcppl.distributions.poses.base import HELD
from bcppl.distributions.poses.boxed import BoxedNormal
from bcppl.distributions.poses.normal import MixturePose, NormalPose, NormalTwist
from bcppl.distributions.poses.uniform import SwingTwistPose, UniformPose, prior_from_guess, tilt_and_yaw

__all__ = [
    "HELD",
    "BoxedNormal",
    "MixturePose",
    "NormalPose",
    "NormalTwist",
    "SwingTwistPose",
    "UniformPose",
    "prior_from_guess",
    "tilt_and_yaw",
]
