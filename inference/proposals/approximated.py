"""Proposals guided by a Gaussian approximation of the posterior (`bcppl.inference.approximations.gaussian`).

Forward and backward kernels of SMCP3 for a new measurement, an independence proposal from the approximate
conditional, and a random walk of the part together with the nuisance parameters of its instruments.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.devices import on_device_of
from bcppl.distributions.pose_normals import GaussianMixture, transport, widened_mixture
from bcppl.distributions.poses import MixturePose, NormalPose, NormalTwist
from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.sensors.capabilities import FitsPose
from bcppl.traces import Program, Trace

# Correlations of standardised deviations before and after a proposal: of the part, of nuisance parameters
# that follow it to anywhere, and of those in a random walk.
MOVED, FOLLOWING, WALKING = 0.9, 0.98, 0.9
SCALES = torch.tensor([0.1, 1.5], dtype=torch.float64).log()  # of a random walk
_SAME = 25.0  # squared standard deviations: components that are nearer are the same before and after
_KNOWN = 1e-14  # variance (m^2, rad^2) of a pose that is given
_STAYING = 0.8  # probability that a particle stays with the same component


def forward_kernel(source: GaussianApproximation, target: GaussianApproximation, action: Any) -> Program:
    """Forward kernel: the nuisance parameters that come with a measurement, and the part's pose given it."""

    def program(trace: Trace) -> None:
        before, after = source.here, target.here
        sensor = after.scene.sensor(action)
        if not isinstance(sensor, FitsPose):
            _follow(trace, after, _transported(trace, before, after), FOLLOWING)
            return
        values = {}
        if sensor.brings_nuisances(action, trace):
            fit = after.fits[sensor.viewpoint(action)].fit
            values = dict(sensor.propose(action, fit, before.predicted(trace), trace))
        pyro.sample(after.pose, after.conditional(trace, values))

    return program


def backward_kernel(source: GaussianApproximation, target: GaussianApproximation, action: Any) -> Program:
    """Backward kernel: the part's pose, and after a contact the nuisance parameters, as before it."""

    def program(trace: Trace) -> None:
        before, after = source.here, target.here
        if isinstance(after.scene.sensor(action), FitsPose):
            pyro.sample(before.pose, before.conditional(trace))
        else:
            _follow(trace, before, _transported(trace, after, before), FOLLOWING)

    return program


def independent_proposal(given: GaussianApproximation) -> Callable[..., None]:
    """A program that draws the part's pose and its instruments' nuisance parameters, whatever they were."""

    def program(*args: Any) -> None:
        approximation = given.here
        part = pyro.sample(approximation.pose, approximation.widened)
        known = NormalPose(part, part.new_zeros(6, 6) + _KNOWN * torch.eye(6, dtype=torch.float64))
        values: dict[str, Tensor] = {}
        for each in approximation.fits.values():
            values |= approximation.scene.sensor(each.action).propose(each.action, each.fit, known, values)

    return program


def conditional_proposal(given: GaussianApproximation) -> Program:
    """An independence proposal of the part's pose, from its conditional given the nuisance parameters."""

    def program(trace: Trace) -> None:
        approximation = given.here
        pyro.sample(approximation.pose, approximation.conditional(trace))

    return program


def joint_proposal(given: GaussianApproximation) -> Program:
    """An independence proposal of the part's pose; the nuisance parameters of its instruments follow it."""

    def program(trace: Trace) -> None:
        approximation = given.here
        _follow(trace, approximation, approximation.widened, FOLLOWING)

    return program


def joint_random_walk(given: GaussianApproximation) -> Program:
    """A random walk of the part's pose with the approximate covariance; nuisance parameters follow it."""

    def program(trace: Trace) -> None:
        approximation = given.here
        size = torch.exp(pyro.sample("walk", dist.Uniform(*on_device_of(SCALES, trace[approximation.pose]))))
        pose, mixture = trace[approximation.pose], approximation.mixture
        covariance = mixture.covariances[mixture.component(pose)]
        step = (2.38 * size) ** 2 / 6.0
        _follow(trace, approximation, NormalTwist(pose, step[:, None, None] * covariance), WALKING)

    return program


def _follow(trace: Trace, approximation: GaussianApproximation, proposed: Any, correlation: float) -> None:
    """Sample the part's pose from a proposal, and the instruments' nuisance parameters to match it."""
    old, new = trace[approximation.pose], pyro.sample(approximation.pose, proposed)
    values: dict[str, Tensor] = {}
    for each in approximation.fits.values():
        sensor = approximation.scene.sensor(each.action)
        values |= sensor.accompany(each.action, each.fit, trace, old, new, correlation, values)


def _transported(trace: Trace, source: GaussianApproximation, target: GaussianApproximation) -> MixturePose:
    """Optimal transport of the particles from one approximation to another, with some noise.

    A measurement that carries little information moves them little.
    """
    start, goal = source.mixture, target.mixture
    pose = trace[source.pose]
    own, transitions = start.component(pose), component_transitions(start, goal)
    away = poses.log(start.centers[own], pose)
    maps = torch.stack(
        [torch.stack([transport(one, other) for other in goal.covariances]) for one in start.covariances]
    )
    moved = (away[:, None, None] @ maps[own])[:, :, 0]
    return widened_mixture(
        GaussianMixture(
            poses.exp(goal.centers, MOVED * moved),
            ((1.0 - MOVED**2) * goal.covariances).expand(trace.particles, -1, 6, 6),
            transitions[own],
        )
    )


def component_transitions(start: GaussianMixture, goal: GaussianMixture) -> Tensor:
    """Log-probabilities (M, K) of going from each of M components to each of K others.

    Most particles go to components that coincide with their own, given more measurements.
    """
    away = poses.log(start.centers[:, None], goal.centers)
    both = start.covariances[:, None] + goal.covariances
    squared = (away * torch.linalg.solve(both, away[..., None])[..., 0]).sum(dim=-1)
    any_component = goal.log_weights.log_softmax(dim=0).expand(len(start.centers), -1)
    same = squared < _SAME
    same = same | ~same.any(dim=1, keepdim=True)
    near = torch.where(same, any_component, -torch.inf).log_softmax(dim=1)
    return torch.logaddexp(near + math.log(_STAYING), any_component + math.log1p(-_STAYING))
