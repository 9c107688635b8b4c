"""Likelihood of a held peg's touches by episodes of contact."""

from bcppl.distributions.episodes.filter.row_errors import Hypothesis
from bcppl.distributions.episodes.likelihood import ContactEpisodes
from bcppl.distributions.episodes.linear_errors import LinearError, LinearErrors
from bcppl.distributions.episodes.nuisances import (
    ArmCompliance,
    Delay,
    Grasp,
    KinematicError,
    PartSlides,
    Size,
)

__all__ = [
    "ArmCompliance",
    "ContactEpisodes",
    "Delay",
    "Grasp",
    "Hypothesis",
    "KinematicError",
    "LinearError",
    "LinearErrors",
    "PartSlides",
    "Size",
]
