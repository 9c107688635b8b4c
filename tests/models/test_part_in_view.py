"""One image among clutter: errors that all its pixels share do not make a belief sure of a wrong place."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import trimesh

from bcppl import poses
from bcppl.beliefs.regions import translation_deviation
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Guess, Part
from bcppl.inference.filters.tempered_smc import infer
from bcppl.models import part_in_view
from bcppl.recordings import Recording
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors import DepthImage, Measurement, View

BOX = trimesh.creation.box((0.06, 0.04, 0.03))
PART = Part("box", np.asarray(BOX.vertices), np.asarray(BOX.faces, dtype=np.int64))
LENS = Camera(
    "front", 80, 60, 200.0, 200.0, 39.5, 29.5, np.array([0, 0, -0.4, 1.0, 0, 0, 0]), near=0.2, far=0.8
)
TRUTH = poses.retract(poses.identity(), torch.tensor([0.004, -0.003, 0.002, 0.02, 0.05, 0.08]).double())
ERRORS = {"shift": 0.003, "turn": 0.035, "bias": 0.005}


def recording(*shifts: tuple[float, float, float]) -> Recording:
    """Views of the box on a table, each by a camera of its own that sees it displaced, metres."""
    views = []
    for k, shift in enumerate(shifts):
        seen = torch.cat([TRUTH[:3] + torch.tensor(shift, dtype=torch.float64), TRUTH[3:]])
        depth = np.minimum(RayCaster(PART).images(LENS, seen[None])[0], 0.43)
        depth += np.random.default_rng(k).laplace(size=depth.shape) * 1e-3
        views.append(
            Measurement(View(replace(LENS, name=f"camera {k}")), DepthImage(depth.astype(np.float32)))
        )
    guess = Guess(poses.identity().numpy(), np.full(3, 0.015), angle=0.2)
    return Recording(PART, guess, views, truth=TRUTH.numpy(), model="part_in_view")


def held(seen: Recording, **settings: float) -> tuple[bool, float, float]:
    """Whether the 90 % region of the translation holds the truth; the mean's distance from it, metres; and
    its square in standard deviations."""
    model = part_in_view.model
    exact = settings.get("shift") == 0.0
    own = replace(
        model, prepare=partial(part_in_view.prepare, **settings), proposals=() if exact else model.proposals
    )
    *_, last = infer(own, seen, particles=40, sweeps=6)
    region = last.belief.credible_region(0.9, translation_deviation)
    off = last.belief.mean[:3] - TRUTH[:3]
    squared = off @ torch.linalg.solve(last.belief.covariance[:3, :3], off)
    return bool(region.contains(TRUTH)), float(off.norm()), float(squared)


@pytest.mark.long
def test_the_region_holds_a_truth_that_an_erring_image_misses_and_without_latent_errors_does_not() -> None:
    displaced = recording((0.003, -0.002, 0.008))
    holds, off, squared = held(displaced, **ERRORS)
    assert holds and off < 0.012 and squared < 6.3  # 90 % of chi-squared with three degrees of freedom
    # Of 40 particles one may stray to the truth, and the region of any mass with it.
    _, off, squared = held(displaced, shift=0.0)
    assert off == pytest.approx(0.0085, abs=0.003) and squared > 50.0


@pytest.mark.long
def test_two_cameras_with_opposite_errors_meet_between() -> None:
    _, off, _ = held(recording((0.004, 0.0, 0.0), (-0.004, 0.0, 0.0)), **ERRORS)
    assert off < 0.004


@pytest.mark.parametrize("wrong", [{"shift": -0.001}, {"turn": 0.0}, {"bias": -1.0}])
def test_what_is_no_spread_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        part_in_view.prepare(recording((0.0, 0.0, 0.0)), **wrong)
