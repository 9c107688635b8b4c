"""Ways to choose what is done next: by what it is expected to tell, and simpler rules to compare with."""

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
from bcppl.inference.design.entropies import mode_entropy
from bcppl.inference.design.expected_entropy import expected_information_gain
from bcppl.inference.design.linearised import linearised_information_gain
from bcppl.inference.design.ranking import Prospect, Ranking
from bcppl.inference.planning.touching import leading_point, middles_of_strokes
from bcppl.inference.population import Population
from bcppl.sensors.candidates import Candidate, action_of, motion_of
from bcppl.sensors.capabilities import Informative, Linearised

# Ranks candidates for a population, given a scene of the model that knows their cameras.
Rank = Callable[[Population, Sequence[Candidate], Any], Ranking]


def by_information(pose: str, **settings: Any) -> Rank:
    """The rule that ranks by expected entropy reduction of a pose: `linearised_information_gain`.

    Args:
        pose: the address of the sought pose.
        settings: further arguments, such as `hypotheses`, `cost` and `rate`; `information` unless the sensors
            of the scene give it (`bcppl.sensors.capabilities.Informative`).
    """

    def rank(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
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
            **{"information": information, **settings},
        )

    return rank


def can_be_linearised(scene: Any, candidates: Sequence[Candidate]) -> bool:
    """Whether `by_information` can rank these candidates with the sensors of a scene."""
    sensors = [scene.sensor(action_of(each)) for each in candidates] if hasattr(scene, "sensor") else []
    return bool(sensors) and all(isinstance(each, Informative | Linearised) for each in sensors)


def by_reweighing(pose: str, **settings: Any) -> Rank:
    """By the same, particles reweighed: for likelihoods that are not linearised, and not sharp.

    Args:
        pose: the address of the sought pose.
        settings: further arguments of `expected_information_gain`; the entropy is `mode_entropy(pose)`.
    """

    def rank(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        _, done = population.trace.args
        return expected_information_gain(
            population, candidates, lambda c: (scene, [*done, action_of(c)]), mode_entropy(pose), **settings
        )

    return rank


def at_random(seed: int = 0) -> Rank:
    """In an order that is drawn anew each time."""
    generator = np.random.default_rng(seed_number(seed))

    def rank(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        return in_order(candidates, list(generator.permutation(len(candidates))))

    return rank


def by_largest_variance(peg: Part, pose: str) -> Rank:
    """The touch first that goes to where the belief is least sure of the surface, along its normal.

    Args:
        peg: what is held.
        pose: the address of the sought pose.
    """

    def rank(population: Population, candidates: Sequence[Candidate], scene: Any) -> Ranking:
        belief = population.belief(pose)
        unsure = [surface_variance(belief, peg, each) for each in candidates]
        return in_order(candidates, sorted(range(len(unsure)), key=lambda k: -unsure[k]))

    return rank


def surface_variance(belief: Belief, peg: Part, candidate: Candidate) -> float:
    """The variance (m^2) of where a surface is that a plan is to meet, along its stroke.

    Of several strokes the largest; -inf where there is none, and for views.
    """
    motion = motion_of(candidate)
    strokes = [] if motion is None else middles_of_strokes(motion)
    found = [-math.inf]
    for middle, way in strokes:
        world_from_peg, direction = torch.from_numpy(middle), torch.from_numpy(way)
        led = poses.rotation_matrix(world_from_peg).T @ direction
        place = poses.transform(world_from_peg, torch.from_numpy(leading_point(peg, led.numpy()))[None])
        in_part = poses.transform(poses.inverse(belief.mean), place)
        along = poses.transform(belief.world_from_part, in_part)[:, 0] @ direction
        found.append(float(belief.weights @ (along - belief.weights @ along) ** 2))
    return max(found)


def in_order(candidates: Sequence[Candidate], order: Sequence[int] | None = None) -> Ranking:
    """A ranking by an order that is given, which foretells nothing: gains are NaN."""
    none = torch.full((1,), math.nan, dtype=torch.float64)
    return Ranking(
        tuple(
            Prospect(candidates[k], int(k), math.nan, math.nan, math.nan, 0.0, 1, none, torch.ones_like(none))
            for k in (range(len(candidates)) if order is None else order)
        ),
        math.nan,
    )
