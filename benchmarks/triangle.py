"""Where to push next, on real pushes: one contact leaves a triangle free to slide along an edge.

The triangle lies within 20 mm and 3 degrees of the guess. A push is drawn from a log of real ones and
assimilated; the belief is then long along the edge that was touched. The next push is chosen among others of
the log by its expected information, and its real measurements are assimilated. Reported are the edge on which
it lay (by the true pose, which inference does not use), and what is left of the slide.
With `--every` also what the others would have left, for in some draws few or none of them end it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from report import Row, cores, finish, options, show
from torch import Tensor
from touches import LOGS, OTHER, learnt

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.contact.touch import Touch
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.gap import Gap
from bcppl.inference.design import (
    expected_information_gain,
    linearised_information_gain,
    mixture_entropy,
    weight_entropy,
)
from bcppl.inference.filters.smc import Step
from bcppl.inference.filters.tempered_smc import infer
from bcppl.models.point_probe import model
from bcppl.recordings.importers.point_probe import command
from bcppl.sensors import Push, Recording
from bcppl.sensors.likelihoods.point_finger import contact_of
from bcppl.sweeps import in_order
from bcppl.traces import Trace, extend

LOG = "10_90"
YAW = 3.0  # degrees; with more, another contact on the same edge is worth as much as one on another
PARTICLES, CANDIDATES, OUTER_SAMPLES = 75, 32, 16
GONE = 1.0 / 3.0  # of how far it could slide
WAYS = ("entropy of weights", "entropy of the pose", "information added up")


class Chosen(NamedTuple):
    """What came of one draw and one way to choose.

    Attributes:
        another: whether the second push lay on another edge than the first.
        before, after: how far the part could slide along the edge first touched (`slide`), mm.
        by_chance: the same after the first candidate, for which nobody asked.
        least: the same after whichever candidate left least, as it turned out; NaN where nobody looked.
        share: of the candidates that lay on another edge.
    """

    another: bool
    before: float
    after: float
    by_chance: float
    least: float
    share: float

    @property
    def gone(self) -> bool:
        """Whether it can slide no more."""
        return self.after <= GONE * self.before

    @property
    def could_be(self) -> bool:
        """Whether some candidate, had it been chosen, would have left it no slide."""
        return self.least <= GONE * self.before


def edge_of(recording: Recording, push: int, settings: Any) -> Tensor:
    """The outward normal (3,), in the part's frame, of the edge that a push met, by the true pose."""
    one, truth = recording.measurements[push], torch.as_tensor(recording.truth)
    assert isinstance(one.action, Push) and isinstance(one.observation, Touch)
    onset = contact_of(one.action, one.observation, settings).onset
    place = poses.transform(poses.inverse(truth), onset[None])
    return SignedDistance(recording.part)(place).normal[0]


def slide(belief: Belief, recording: Recording, normal: Tensor) -> float:
    """How far (mm, a standard deviation) the part may slide along an edge with a normal (3,).

    That is how far its middle may be along the edge once its yaw is known: what it owes to its yaw by linear
    regression is left out, for no slide is needed for it.
    """
    middle = torch.tensor(recording.part.mesh.centroid, dtype=torch.float64)
    truth = torch.as_tensor(recording.truth)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    along = poses.rotation_matrix(truth) @ torch.linalg.cross(up, normal)
    there = poses.transform(belief.world_from_part, middle[None])[:, 0] @ along
    yaw = poses.local(truth, belief.world_from_part)[:, 5]
    covariance = torch.cov(torch.stack([there, yaw]), correction=0, aweights=belief.weights)
    return 1e3 * float((covariance[0, 0] - covariance[0, 1] ** 2 / covariance[1, 1]).clamp(min=0.0).sqrt())


def after(recording: Recording, numbers: Sequence[int], scene: Any, seed: int, start: Any = None) -> Step:
    """The last step of a run over some of the pushes, in their order, or of what is left after a step."""
    some = replace(recording, measurements=[recording.measurements[k] for k in numbers])
    *_, last = infer(model, some, particles=PARTICLES, seed=seed, scene=scene, start=start)
    return last


def information(arguments: Callable[[Any], tuple[Any, ...]], push: Push, trace: Trace) -> Tensor:
    """The information (H, 6, 6) of an onset: of the distance of the finger from the edge that it meets."""
    scene, pushes = arguments(push)
    longer, _ = extend(trace, (scene, pushes), {})
    onset, part = longer[f"onset_{len(pushes) - 1}"], longer["part"]
    felt_at = torch.where(torch.isnan(onset), part[:, :3], onset)
    place = poses.transform(poses.inverse(part), felt_at[:, None])
    finger = scene.sensor(push)
    near = finger.distance(place[:, 0])
    gradient = Gap(near.distance[:, None], place, near.normal[:, None]).gradient(part)
    missed = torch.isnan(onset).any(dim=1)[:, None, None]
    gradient = torch.where(missed, 0.0, gradient) / finger.settings.spread
    return gradient.transpose(-1, -2) @ gradient


def chosen(
    seed: int, candidates: int = CANDIDATES, outer_samples: int = OUTER_SAMPLES, every: bool = False
) -> list[Chosen]:
    """One draw, each way, from so many pushes; `every` one of them is tried as well."""
    logs = sorted(LOGS.glob(f"{LOG}_10_10*"))
    recording = command(logs, pushes=1 + candidates, seed=seed, yaw=YAW)
    settings = learnt(OTHER[LOG])
    scene = model.prepare(recording, **asdict(settings))
    first = after(recording, [0], scene, seed)
    edges = torch.stack([edge_of(recording, k, settings) for k in range(1 + candidates)])
    another = (edges @ edges[0] < math.cos(math.radians(45.0))).tolist()
    others = range(1, 1 + candidates)
    actions = [recording.measurements[k].action for k in others]
    done = [recording.measurements[0].action]

    def arguments(push: Any) -> tuple[Any, ...]:
        return scene, [*done, push]

    before = slide(first.belief, recording, edges[0])

    @cache
    def left(second: int) -> float:
        step = after(recording, [0, second], scene, seed, first)
        return slide(step.belief, recording, edges[0])

    found, least = [], min(left(k) for k in others) if every else math.nan
    rankings = [
        *(
            expected_information_gain(
                first.population, actions, arguments, entropy, outer_samples=outer_samples, seed=seed
            )
            for entropy in (weight_entropy(), mixture_entropy("part"))
        ),
        linearised_information_gain(
            first.population, actions, arguments, information=partial(information, arguments), seed=seed
        ),
    ]
    for ranking in rankings:
        best = others[ranking.best.number]
        found.append(Chosen(another[best], before, left(best), left(1), least, float(np.mean(another[1:]))))
    one = found[0]
    edge = "another" if one.another else "the same"
    print(f"draw {seed}: {edge} edge, slide {before:.2f} to {one.after:.2f} mm", file=sys.stderr, flush=True)
    return found


def main() -> None:
    parser: argparse.ArgumentParser = options(__doc__ or "")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes, of one thread each if several")
    parser.add_argument("--candidates", type=int, default=CANDIDATES, help="pushes to choose from")
    parser.add_argument("--outer-samples", type=int, default=OUTER_SAMPLES, help="true values")
    parser.add_argument("--every", action="store_true", help="report what every candidate would have left")
    arguments = parser.parse_args()
    if arguments.candidates < 1:
        parser.error(f"--candidates is {arguments.candidates}; give one or more.")
    if not LOGS.is_dir():
        print(f"skipped: the push logs are not at {LOGS}.")
        return
    draws = 3 if arguments.quick else 20
    choose = partial(
        chosen,
        candidates=arguments.candidates,
        outer_samples=arguments.outer_samples,
        every=arguments.every,
    )
    results = list(in_order(choose, range(arguments.seed, arguments.seed + draws), arguments.jobs))
    rows, lines = [], []
    for k, name in enumerate(WAYS):
        own = [one[k] for one in results]
        counts = sum(one.another for one in own), sum(one.gone for one in own)
        numbers = [float(np.median([getattr(one, field) for one in own])) for field in Chosen._fields[1:5]]
        share = float(np.mean([one.share for one in own]))
        possible = sum(one.could_be for one in own) if arguments.every else math.nan
        lines.append([name, *counts, possible, *numbers, share])
        goal = 0.9 * draws if k == 0 else None
        rows += [
            Row(f"{name}: next push on another edge", counts[0], f"of {draws}", goal, "min"),
            Row(f"{name}: slide gone after it", counts[1], f"of {draws}", goal, "min"),
            Row(f"{name}: slide before, median", numbers[0], "mm"),
            Row(f"{name}: slide after, median", numbers[1], "mm"),
            Row(f"{name}: slide after a push by chance, median", numbers[2], "mm"),
            Row(f"{name}: candidates on another edge", share, "", direction="min"),
        ]
        if arguments.every:
            rows.append(Row(f"{name}: some push ends it", possible, f"of {draws}", direction="min"))
    columns = [
        "entropy",
        "another edge",
        "gone",
        "could be",
        "slide mm",
        "after mm",
        "by chance mm",
        "at least mm",
        "candidates on another",
    ]
    show(
        f"one real push, then the best of {arguments.candidates}: {draws} draws, {PARTICLES} particles",
        columns,
        lines,
    )
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
