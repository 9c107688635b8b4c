"""Beliefs: weighted particles read as a posterior over a part's pose."""

from bcppl.beliefs.belief import Belief, Mode, entropy_of_modes
from bcppl.beliefs.distances import average_distance, average_nearest_distance
from bcppl.beliefs.regions import (
    Region,
    average_point_distance,
    pose_deviation,
    rotation_angle,
    rotation_deviation,
    translation_deviation,
    translation_distance,
)
from bcppl.beliefs.weights import effective_sample_size, normalised, weighted_quantiles

__all__ = [
    "Belief",
    "Mode",
    "Region",
    "average_distance",
    "average_nearest_distance",
    "average_point_distance",
    "effective_sample_size",
    "entropy_of_modes",
    "normalised",
    "pose_deviation",
    "rotation_angle",
    "rotation_deviation",
    "translation_deviation",
    "translation_distance",
    "weighted_quantiles",
]
