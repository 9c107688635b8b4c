"""Noise of a wrench, and its covariance after averaging, filtering and taring."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfilt

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError


@dataclass(frozen=True)
class WrenchNoise:
    """Independent noise of the samples of a wrench, isotropic in force and in torque.

    Attributes:
        force: standard deviation of a force, N.
        torque: standard deviation of a torque, N m.
    """

    force: float = 0.1
    torque: float = 0.005

    def __post_init__(self) -> None:
        number_within("a wrench has noise of {} N", self.force, above=0.0)
        number_within("a wrench has noise of {} N m", self.torque, above=0.0)

    def covariance(self, share: float = 1.0) -> Array:
        """Covariance (6, 6) of a wrench with a share of a sample's variance.

        Args:
            share: 1 / n for the mean of n samples, `variance_gain` after a filter; and 1 / n more where the
                sensor's zero is the mean of n samples.
        """
        return share * np.diag([self.force**2] * 3 + [self.torque**2] * 3)


def covariance_of(given: Array | WrenchNoise) -> Array:
    """Covariances (6, 6) or (M, 6, 6) of wrenches, symmetric to the bit.

    Raises:
        InputError: one is not symmetric.
    """
    covariance = given.covariance() if isinstance(given, WrenchNoise) else np.asarray(given, np.float64)
    turned = np.swapaxes(covariance, -1, -2)
    scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=-2, axis2=-1)))
    if (np.abs(covariance - turned) > 1e-6 * scale[..., None] * scale[..., None, :]).any():
        raise InputError("the wrenches' covariance is not symmetric; give one that equals its transpose.")
    return 0.5 * (covariance + turned)


def noise_at_rest(wrench: Array) -> WrenchNoise:
    """The noise of samples (n, 6) without contact, estimated from their variance.

    Raises:
        InputError: a sample is not finite.
    """
    variance = np.asarray(wrench, dtype=np.float64).var(axis=0, ddof=1)
    return WrenchNoise(float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean())))


def position_noise(places: Array) -> float:
    """The noise (m) of places (T,) or (T, 3) at even stamps, by the median of their second differences.

    A motion that is not smooth over three stamps adds to it. Infinite for fewer than ten.
    """
    if len(places) < 10:
        return math.inf
    return float(np.median(np.abs(np.diff(places, n=2, axis=0)))) / (0.6745 * 6.0**0.5)


def variance_gain(sections: Array) -> float:
    """Variance of filtered white noise of unit variance, for a filter of second-order sections (S, 6)."""
    impulse = np.zeros(20000)
    impulse[0] = 1.0
    return float(np.square(sosfilt(sections, impulse)).sum()) if len(sections) else 1.0
