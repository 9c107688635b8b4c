"""Noise of a wrench, and its covariance after averaging, filtering and taring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfilt

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
        if not (0 < self.force < np.inf and 0 < self.torque < np.inf):
            raise InputError(
                f"a wrench has noise of {self.force!r} N and {self.torque!r} N m; give numbers above 0."
            )

    def covariance(self, share: float = 1.0) -> Array:
        """Covariance (6, 6) of a wrench with a share of a sample's variance.

        Args:
            share: 1 / n for the mean of n samples, `variance_gain` after a filter; and 1 / n more where the
                sensor's zero is the mean of n samples.
        """
        return share * np.diag([self.force**2] * 3 + [self.torque**2] * 3)


def checked_covariance(given: Array | WrenchNoise, wrenches: int) -> Array:
    """Covariances (6, 6) or (M, 6, 6) of M wrenches, as float64.

    Raises:
        InputError: the shape does not fit, or one is not symmetric and positive definite.
    """
    covariance = given.covariance() if isinstance(given, WrenchNoise) else np.asarray(given, np.float64)
    if covariance.shape not in ((6, 6), (wrenches, 6, 6)):
        raise InputError(
            f"the covariance has shape {covariance.shape} for {wrenches} wrenches; give (6, 6) or (M, 6, 6)."
        )
    turned = np.swapaxes(covariance, -1, -2)
    scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=-2, axis2=-1)))
    if (np.abs(covariance - turned) > 1e-6 * scale[..., None] * scale[..., None, :]).any():
        raise InputError("the wrenches' covariance is not symmetric; give one that equals its transpose.")
    covariance = 0.5 * (covariance + turned)
    least = np.linalg.eigvalsh(covariance).min(initial=1.0) if np.isfinite(covariance).all() else -1.0
    if not least > 0:
        raise InputError("the wrenches' covariance is not positive definite; give every axis some noise.")
    return covariance


def noise_at_rest(wrench: Array) -> WrenchNoise:
    """The noise of samples (n, 6) without contact, estimated from their variance.

    Raises:
        InputError: fewer than five samples, or one that is not finite.
    """
    wrench = np.asarray(wrench, dtype=np.float64)
    if len(wrench) < 5 or not np.isfinite(wrench).all():
        raise InputError(
            f"wrenches at rest have shape {wrench.shape} or are not finite; give five samples (n, 6) or more."
        )
    variance = wrench.var(axis=0, ddof=1)
    return WrenchNoise(float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean())))


def variance_gain(sections: Array) -> float:
    """Variance of filtered white noise of unit variance, for a filter of second-order sections (S, 6)."""
    impulse = np.zeros(20000)
    impulse[0] = 1.0
    return float(np.square(sosfilt(sections, impulse)).sum()) if len(sections) else 1.0
