"""Depth among clutter: a density that its own draws bear out, what it prefers, and what must not matter."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.distributions.checks import Check
from bcppl.distributions.depth import ClutteredDepth, RobustDepth
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.models import part_in_view
from bcppl.recordings.importers import bop
from bcppl.rendering.ray_casting import RayCaster

CLUTTER = Path(__file__).parents[3] / "shared/data/lmo_scene2_frame3"

BOX = trimesh.creation.box((0.06, 0.04, 0.03))
RENDERER = RayCaster(Part("box", np.asarray(BOX.vertices), np.asarray(BOX.faces, dtype=np.int64)))
EYE = np.array([0, 0, -0.4, 1.0, 0, 0, 0])
SCALE, STEP = 0.004, 0.004


def camera(width: int, height: int, focal: float) -> Camera:
    return Camera(
        "front", width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), EYE, near=0.2, far=0.8
    )


def at(*places: tuple[float, float, float]) -> Tensor:
    return torch.tensor([[*place, 1.0, 0.0, 0.0, 0.0] for place in places], dtype=torch.float64)


def depths(cells: int) -> Tensor:
    """The middles of so many cells of the sensor's range."""
    return 0.2 + 0.6 * (torch.arange(cells, dtype=torch.float64) + 0.5) / cells


@pytest.mark.long
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.055, 0.0, 0.0), (5.0, 0.0, 0.0)])
@pytest.mark.parametrize("rim", [0, 1])
def test_rows_are_a_density(place: tuple[float, float, float], rim: int) -> None:
    """Two pixels: both on the part, the right one alone, or none."""
    lens, cells = camera(2, 1, 8.0), 80
    grid = depths(cells)
    images = torch.stack(torch.meshgrid(grid, grid, indexing="ij"), dim=-1).reshape(-1, 1, 2)
    site = ClutteredDepth(RENDERER, lens, at(place).expand(len(images), 7), 0.02, step=0.02, lines=1, rim=rim)
    volume = float(site._of_lines(images)[0].exp().sum()) * (0.6 / cells) ** 2
    # Unknown depth goes on beyond the sensor's range in one case of thirty, and the cells are coarse.
    assert 0.96 < volume < 1.01


@pytest.mark.long
def test_draws_follow_the_density_of_rows() -> None:
    """The mean of p'/p over draws from p is 1, whatever p' is; here the part elsewhere."""
    torch.manual_seed(0)
    lens, count = camera(12, 1, 60.0), 5_000
    here, there = (at(place).expand(count, 7) for place in ((0.0, 0.0, 0.0), (0.012, 0.0, -0.004)))
    options: dict[str, Any] = {
        "lines": 1,
        "rim": 1,
        "jump": 0.2,
        "step": 0.02,
        "through": 0.2,
        "correlation": 0.5,
    }
    site, other = (ClutteredDepth(RENDERER, lens, pose, 0.02, **options) for pose in (here, there))
    images = site.sample()
    inside = ((images > 0.2) & (images < 0.8)).all(dim=-1).flatten()
    assert float(inside.double().mean()) > 0.9
    ratio = (other._of_lines(images)[0] - site._of_lines(images)[0])[inside].exp()
    # Draws that leave the range are left out: under both they are about as many.
    assert float(ratio.mean()) == pytest.approx(1.0, abs=4 * float(ratio.std()) / math.sqrt(count) + 0.02)
    assert float(ratio.log().mean()) < -0.5


def scene(box: bool = True, tool: bool = False) -> tuple[Camera, Tensor]:
    """A box on a table, half of it behind a tool if there is one, with errors of 1 mm."""
    lens = camera(80, 60, 200.0)
    image = np.full((60, 80), 0.415)
    if box:
        image = np.minimum(image, RENDERER.images(lens, at((0.0, 0.0, 0.0)))[0])
    if tool:
        image[:, 36:] = 0.3
    noise = np.random.default_rng(0).laplace(size=image.shape) * 1e-3
    return lens, torch.from_numpy(image + noise)


def test_half_a_part_is_found_where_independent_pixels_would_have_it_in_the_table() -> None:
    lens, image = scene(tool=True)
    # At its place, sunk into the table beside it, and hidden behind the tool.
    poses = at((0.0, 0.0, 0.0), (-0.045, 0.0, 0.03), (0.06, 0.0, 0.03))
    cluttered = ClutteredDepth(RENDERER, lens, poses, SCALE).log_prob(image)
    assert int(cluttered.argmax()) == 0 and float(cluttered[0] - cluttered[1:].max()) > 10.0
    independent = RobustDepth(RENDERER, lens, poses, SCALE, outlier=0.05).log_prob(image)
    assert int(independent.argmax()) == 1


def test_a_part_that_is_hidden_altogether_says_little_and_one_that_is_seen_through_much() -> None:
    lens, image = scene(box=False, tool=True)
    gone, hidden, before, through = ClutteredDepth(
        RENDERER, lens, at((5.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.05, 0.0, -0.12), (-0.04, 0.0, -0.05)), SCALE
    ).log_prob(image)
    assert -60.0 < float(hidden - gone) < 0.0
    assert float(before - gone) < -100.0 and float(through - gone) < -100.0


def test_missing_pixels_are_skipped_and_nothing_of_them_is_read() -> None:
    lens, image = scene()
    poses = at((0.0, 0.0, 0.0), (0.01, 0.0, 0.0))
    holes = torch.rand(image.shape, generator=torch.Generator().manual_seed(1)) < 0.2
    said = [
        ClutteredDepth(RENDERER, lens, poses, SCALE).log_prob(torch.where(holes, value, image))
        for value in (math.nan, 0.0, 0.1, 7.0, math.inf)
    ]
    for other in said[1:]:
        torch.testing.assert_close(other, said[0], rtol=0.0, atol=0.0)
    assert torch.isfinite(said[0]).all() and float(said[0][0]) > float(said[0][1])
    nothing = ClutteredDepth(RENDERER, lens, poses, SCALE).log_prob(torch.full_like(image, math.nan))
    assert nothing.tolist() == [0.0, 0.0]
    # Of the same image, which was read without a region first.
    whole = ClutteredDepth(RENDERER, lens, poses, SCALE).log_prob(image)
    masked = ClutteredDepth(RENDERER, lens, poses, SCALE, region=~holes).log_prob(image)
    torch.testing.assert_close(masked, said[0], rtol=0.0, atol=0.0)
    assert not torch.equal(masked, whole)


def test_an_image_for_each_particle_an_image_written_to_and_a_temperature() -> None:
    lens, image = scene()
    poses = at((0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (5.0, 0.0, 0.0))
    site = ClutteredDepth(RENDERER, lens, poses, SCALE)
    together = site.log_prob(image)
    torch.testing.assert_close(site.log_prob(image.expand(3, -1, -1).clone()), together)
    alone = [ClutteredDepth(RENDERER, lens, pose[None], SCALE).log_prob(image) for pose in poses]
    torch.testing.assert_close(torch.cat(alone), together)
    warm = ClutteredDepth(RENDERER, lens, poses, SCALE, temperature=2.0)
    torch.testing.assert_close(warm.log_prob(image), 0.5 * together)
    image[20:40] = 0.35
    written = site.log_prob(image)
    assert not torch.equal(written, together)
    torch.testing.assert_close(written, site.log_prob(image.clone()), rtol=0.0, atol=0.0)


def test_a_part_that_is_seen_through_surprises_and_one_that_is_hidden_or_right_does_not() -> None:
    """A box that is where it is believed to be, behind a tool, and 20 mm beside."""
    lens = camera(240, 180, 600.0)
    rng = np.random.default_rng(0)

    def image(*shift: float, tool: bool = False) -> Tensor:
        depth = np.minimum(RENDERER.images(lens, at(shift or (0.0, 0.0, 0.0)))[0], 0.43)  # type: ignore[arg-type]
        if tool:
            depth[:, 108:] = 0.3
        return torch.from_numpy(depth + rng.laplace(size=depth.shape) * 1e-3)

    def check(seen: Tensor) -> Check:
        site = ClutteredDepth(RENDERER, lens, at((0.0, 0.0, 0.0), (0.0005, 0.0, 0.0)), SCALE)
        return site.predictive_check(seen, lambda: None)

    assert check(image()).probability > 0.5 and check(image(tool=True)).probability > 0.5
    assert check(torch.full((180, 240), math.nan)).probability == 1.0
    for shift in ((0.02, 0.0, 0.0), (0.0, -0.02, 0.0), (0.014, 0.014, 0.0)):
        moved = check(image(*shift))
        assert moved.kind == "through" and moved.surprising and moved.excess > 4.0


def test_turned_images_say_the_same() -> None:
    """Rows count as much as columns: a scene mirrored at the image's diagonal has the same density."""
    _, image = scene(tool=True)
    square = camera(60, 60, 200.0)
    cut = image[:, 10:70].contiguous()
    turned = torch.tensor([[0.01, 0.0, 0.0, math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]], dtype=torch.float64)
    plain = torch.tensor([[0.0, 0.01, 0.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    first = ClutteredDepth(RENDERER, square, plain, SCALE, lines=1).log_prob(cut)
    second = ClutteredDepth(RENDERER, square, turned, SCALE, lines=1).log_prob(cut.T.contiguous())
    torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-3)


def test_a_pose_that_is_none_and_an_image_of_another_size_are_refused() -> None:
    lens, image = scene()
    with pytest.raises(InputError, match="particles 1"):
        ClutteredDepth(RENDERER, lens, at((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0)), SCALE).log_prob(image)
    with pytest.raises(InputError, match=r"shape \(59, 80\)"):
        ClutteredDepth(RENDERER, lens, at((0.0, 0.0, 0.0)), SCALE).log_prob(image[1:])
    with pytest.raises(InputError, match=r"\(3, 6\); give \(3, 7\)"):
        ClutteredDepth(RENDERER, lens, torch.zeros(3, 6), SCALE)


@pytest.mark.skipif(not CLUTTER.is_dir(), reason=f"the BOP scene is not at {CLUTTER}")
@pytest.mark.parametrize(
    ("object_id", "millimetres", "degrees"),
    [(1, (-50.2, 58.0, -1.2), (-5.2, 11.9, 10.0)), (10, (8.0, -9.7, -35.6), (14.7, 8.8, 41.5))],
)
def test_a_real_part_is_not_mistaken_for_the_tool_before_it(
    object_id: int, millimetres: tuple[float, ...], degrees: tuple[float, ...]
) -> None:
    """An ape of which a fifth shows behind a drill, and where it best fits the drill's foot; an egg box under
    a toy car, and where it best fits the two together: what pixels prefer that are independent."""
    recording = bop.command(CLUTTER, object_id=object_id)
    truth = torch.as_tensor(recording.truth)
    step = [1e-3 * x for x in millimetres] + [math.radians(x) for x in degrees]
    both = torch.stack([truth, poses.retract(truth, torch.tensor(step, dtype=torch.float64))])
    view, observation = recording.measurements[0].action, recording.measurements[0].observation
    gains = []
    for settings in ({}, {"clutter": False, "effective_pixels": None}):
        prepared = part_in_view.prepare(recording, **settings)
        likelihood = prepared.sensor(view).image(view.camera, both)
        log_prob = likelihood.log_prob(torch.from_numpy(observation.depth))
        gains.append(float(log_prob[0] - log_prob[1]))
    assert gains[0] > 40.0 and gains[1] < -200.0
