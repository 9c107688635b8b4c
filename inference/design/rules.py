"""Acquisition rules: rankings of candidates by expected information gain, and simpler ones as baselines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from bcppl import poses
from bcppl.arguments import seed_number
from bcppl.beliefs import Belief
from bcppl.geometry.parts import Part
from bcppl.inference.design.entropies import mixture_entropy
from bcppl.inference.design.expected_entropy import expected_information_gain
from bcppl.inference.design.linearised import linearised_information_gain
from bcppl.inference.design.ranking import Ranking, Utility
from bcppl.inference.design.relative_mixture import HeldPeg
from bcppl.inference.planning.motions import expected_contacts
from bcppl.inference.planning.touching import leading_point
from bcppl.inference.population import Population
from bcppl.sensors.candidates import Candidate, action_of, motion_of
from bcppl.sensors.capabilities import Informative, Linearised, SamplesNuisances, Screens, SharesErrors

# Ranks candidates for a population, given a scene of the model that knows their cameras.
AcquisitionRule = Callable[[Population, Sequence[Candidate], Any], Ranking]


def by_linearised_gain(pose: str, **settings: Any) -> AcquisitionRule:
    """The rule that ranks by the information gain about a pose, by `linearised_information_gain`.

    Where touches share errors (the scene's bench has some), the pose is that relative to the held peg at the
    belief's mean; give `peg=None` for the pose in the world as if they shared none.

    Args:
        pose: the address of the pose.
        settings: further arguments, such as `outer_samples`, `cost` and `rate`; `information` unless the
            sensors of the scene give it (`bcppl.sensors.capabilities.Informative`).
    """

    def rule(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        _, done = population.trace.args

        def information(candidate: Candidate, trace: Any) -> Any:
            action = action_of(candidate)
            sensor = scene.sensor(action) if hasattr(scene, "sensor") else None
            return sensor.information(done, action, trace[pose]) if isinstance(sensor, Informative) else None

        return linearised_information_gain(
            population,
            candidates,
            lambda c: (scene, [*done, action_of(c)]),
            pose,
            **{"information": information, "peg": _held_peg(scene), **settings},
        )

    return rule


def _held_peg(scene: Any) -> HeldPeg | None:
    """The peg of a scene whose touches share errors, whatever the candidates are; None without one."""
    for likelihood in getattr(scene, "likelihoods", {}).values():
        if isinstance(likelihood, SharesErrors) and likelihood.bench.errors:
            return HeldPeg(likelihood.bench, likelihood.inserted, likelihood.shared_prior)
    return None


def can_be_linearised(scene: Any, candidates: Sequence[Candidate]) -> bool:
    """Whether `by_linearised_gain` can rank these candidates with the sensors of a scene."""
    sensors = [scene.sensor(action_of(each)) for each in candidates] if hasattr(scene, "sensor") else []
    # Of what is simulated only the cheap likelihood of the same measurements is linearised.
    return bool(sensors) and all(
        isinstance(each, Informative | Linearised) and not isinstance(each, Screens) for each in sensors
    )


def by_reweighted_gain(pose: str, **settings: Any) -> AcquisitionRule:
    """The rule that ranks by the information gain about a pose, by `expected_information_gain`.

    It suits likelihoods that cannot be linearised and are wide compared with the distances of particles.
    Nuisance parameters that a candidate brings, such as the errors of another camera, are not observed.

    Args:
        pose: the address of the pose.
        settings: further arguments; the entropy is `mixture_entropy(pose)`. `latent` are patterns of the
            addresses that are not observed; by default those of the scene's sensors.
    """

    def rule(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        _, done = population.trace.args
        sampling = [x for x in getattr(scene, "likelihoods", {}).values() if isinstance(x, SamplesNuisances)]
        latent = [address for each in sampling for address in each.nuisance_addresses]
        return expected_information_gain(
            population,
            candidates,
            lambda c: (scene, [*done, action_of(c)]),
            mixture_entropy(pose),
            **{"latent": latent, **settings},
        )

    return rule


def at_random(seed: int = 0) -> AcquisitionRule:
    """The rule that ranks in a random order, another one each time."""
    generator = np.random.default_rng(seed_number(seed))

    def rule(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        return in_given_order(candidates, list(generator.permutation(len(candidates))))

    return rule


def by_surface_variance(peg: Part, pose: str) -> AcquisitionRule:
    """The rule that ranks a peg's touches by the variance of the surface's position along its normal."""

    def rule(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        belief = population.belief(pose)
        variances = [surface_variance(belief, peg, each) for each in candidates]
        return in_given_order(candidates, sorted(range(len(variances)), key=lambda k: -variances[k]))

    return rule


def surface_variance(belief: Belief, peg: Part, candidate: Candidate) -> float:
    """The variance (m^2) of the position of the surface that a plan is to touch, along its stroke.

    Of several strokes the largest; -inf without a stroke.
    """
    motion = motion_of(candidate)
    variances = [-math.inf]
    for pose, direction in [] if motion is None else expected_contacts(motion):
        world_from_peg, along = torch.from_numpy(pose), torch.from_numpy(direction)
        in_peg = poses.rotation_matrix(world_from_peg).T @ along
        contact = poses.transform(world_from_peg, torch.from_numpy(leading_point(peg, in_peg.numpy()))[None])
        in_part = poses.transform(poses.inverse(belief.mean), contact)
        position = poses.transform(belief.world_from_part, in_part)[:, 0] @ along
        variances.append(float(belief.weights @ (position - belief.weights @ position) ** 2))
    return max(variances)


def in_given_order(candidates: Sequence[Candidate], order: Sequence[int] | None = None) -> Ranking:
    """A ranking in a given order, without expected gains: these are NaN."""
    none = torch.full((1,), math.nan, dtype=torch.float64)
    return Ranking(
        tuple(
            Utility(candidates[k], int(k), math.nan, math.nan, math.nan, 0.0, 1, none, torch.ones_like(none))
            for k in (range(len(candidates)) if order is None else order)
        ),
        math.nan,
    )
