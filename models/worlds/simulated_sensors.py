"""Simulated sensors of the worlds: poses in error, depth images, and windows of a probe."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.ndimage import uniform_filter1d

from bcppl import poses
from bcppl.arrays import Array
from bcppl.contact.physics import Rollout
from bcppl.contact.touch import Touch
from bcppl.distributions.poses import SwingTwistPose
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import DepthImage, Measurement

if TYPE_CHECKING:
    from bcppl.models.worlds.bench.parameters import BenchParameters
    from bcppl.models.worlds.bench.reality import BenchReality

_WRENCH, _DRIFT, _POSE = range(5, 8)  # streams of random numbers, after those of `bench.scene`
STEP = 0.005  # s between the command's poses
_ROUNDED = 12  # steps over which corners are rounded: 60 ms


@dataclass(frozen=True)
class ProbeErrors:
    """Standard deviations of a wrench sensor and of joint encoders.

    Attributes:
        force_noise, torque_noise: of each sample of the wrench, N and N m.
        force_bias, torque_bias: of the untared wrench sensor, N and N m.
        peg_noise, peg_turn: of each sample of the peg's measured pose, metres and radians.
    """

    force_noise: float = 0.1
    torque_noise: float = 0.005
    force_bias: float = 1.0
    torque_bias: float = 0.05
    peg_noise: float = 0.00005
    peg_turn: float = math.radians(0.02)


def per_axis(linear: float, angular: float) -> Array:
    """(6,) a number for the three translations or forces, and another for the three rotations or torques."""
    return np.array([linear] * 3 + [angular] * 3)


def draw_pose(prior: SwingTwistPose, seed: int) -> torch.Tensor:
    """A pose (7,) drawn with a seed that is not inference's, so that no particle is drawn at the truth."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return prior.sample()


def perturbed(pose: torch.Tensor, shift: float, turn: float, generator: np.random.Generator) -> torch.Tensor:
    """A pose (7,) perturbed by normal errors along (m) and about (rad) its axes."""
    return poses.retract(pose, torch.from_numpy(generator.normal(size=6) * per_axis(shift, turn)))


def depth_image(depth: Array) -> DepthImage:
    """An image (H, W) in metres, rounded as it is stored."""
    return DepthImage(depth.astype(np.float32).astype(np.float64))


def smooth_path(times: Array, values: Array) -> tuple[Array, Array]:
    """Times (T,) 5 ms apart, and straight motions between knots (K, d) with corners rounded over 60 ms."""
    fine = np.arange(0.0, times[-1] + 1e-9, STEP)
    straight = np.stack([np.interp(fine, times, column) for column in values.T], axis=1)
    return fine, uniform_filter1d(straight, _ROUNDED, axis=0, mode="nearest")


def windows(probe: Probe, wrench: Array, world_from_peg: Array, length: int) -> list[Measurement]:
    """Measurements (T, 6) and (T, 7) of a probe in windows of a length, in samples."""
    count = len(probe.stamps)
    measurements = []
    for first in range(0, count, length):
        rows = slice(first, min(first + length, count))
        touch = Touch(probe.stamps[rows], wrench[rows], world_from_peg[rows])
        measurements.append(Measurement(ProbeWindow(probe, rows.start, rows.stop), touch))
    return measurements


def measured_windows(
    probe: Probe, rollout: Rollout, errors: ProbeErrors, length: int, generator: np.random.Generator
) -> list[Measurement]:
    """A simulated probe of one particle, measured with errors, in windows of a length, in samples."""
    size = len(probe.stamps), 6
    noise = generator.normal(size=size) * per_axis(errors.force_noise, errors.torque_noise)
    bias = generator.normal(size=6) * per_axis(errors.force_bias, errors.torque_bias)
    pose_error = generator.normal(size=size) * per_axis(errors.peg_noise, errors.peg_turn)
    world_from_peg = torch.from_numpy(rollout.world_from_peg[0].copy())
    measured = poses.retract(world_from_peg, torch.from_numpy(pose_error)).numpy()
    return windows(probe, rollout.wrench[0] + noise + bias, measured, length)


class SensorErrors:
    """The errors of a scene's wrench sensor and joint encoders; the sensor's bias drifts from use to use.

    Attributes:
        bench: with the errors' standard deviations.
        reality: of this use, with what has slipped in it; None for a bench whose robot is right.
    """

    def __init__(self, bench: BenchParameters, seed: int, reality: BenchReality | None = None) -> None:
        self.bench = bench
        self.reality = reality
        self._bias = np.random.default_rng([seed, _WRENCH]).normal(size=6) * per_axis(
            bench.force_bias, bench.torque_bias
        )
        self._drift, self._noise = (np.random.default_rng([seed, _DRIFT, which]) for which in range(2))
        self._pose = np.random.default_rng([seed, _POSE])

    def sample(self, count: int, rate: float) -> tuple[Array, Array]:
        """The errors of the next `count` samples of the wrench (T, 6) and of the peg's pose (T, 6)."""
        bench, size = self.bench, (count, 6)
        pace = per_axis(bench.force_drift, bench.torque_drift) / math.sqrt(bench.drift_time * rate)
        drift = np.cumsum(self._drift.normal(size=size) * pace, axis=0)
        noise = self._noise.normal(size=size) * per_axis(bench.force_noise, bench.torque_noise)
        error = self._bias + drift + noise
        self._bias = self._bias + drift[-1]
        return error, self._pose.normal(size=size) * per_axis(bench.peg_noise, bench.peg_turn)
