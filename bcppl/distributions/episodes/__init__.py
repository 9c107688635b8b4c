"""Likelihood of a held peg's touches by episodes of contact."""

from bcppl.distributions.episodes.bench_errors import (
    ArmCompliance,
    BenchError,
    BenchErrors,
    Delay,
    Grasp,
    KinematicError,
    PartSlides,
    Size,
)
from bcppl.distributions.episodes.covariances import Hypothesis
from bcppl.distributions.episodes.likelihood import ContactEpisodes

__all__ = [
    "ArmCompliance",
    "BenchError",
    "BenchErrors",
    "ContactEpisodes",
    "Delay",
    "Grasp",
    "Hypothesis",
    "KinematicError",
    "PartSlides",
    "Size",
]
