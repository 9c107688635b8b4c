"""Extrinsics from views of the arm: rendering, the sign of the range bias, and real depth images."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import prior_from_guess
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.parts import Guess, Part
from bcppl.inference.importance import importance_sampling
from bcppl.models.arm_in_view import (
    Scene,
    arm_in_view,
    background_of,
    fitted_proposal,
    observations,
    prepare,
    widened,
)
from bcppl.models.robots import load_robot
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.kinematics import Robot
from bcppl.traces import generate
from tests.models.scene_contents import contents

XARM = Path(__file__).parents[3] / "shared/data/xarm7_realsense"
needed = pytest.mark.skipif(not XARM.is_dir(), reason=f"the xArm's frames are not at {XARM}")

POSTURES = ([0.3, 0.2, -0.4, -1.8, 0.3, 2.0, 0.5], [-0.5, -0.6, 0.8, -1.2, 1.0, 1.6, -0.4])
TRUTH = torch.from_numpy(looking_at([1.3, 0.3, 0.7], [0.1, 0.0, 0.4]))
CAMERA = Camera("c", 96, 72, 90.0, 90.0, 48.0, 36.0, poses.identity().numpy(), 0.3, 5.0)


def near_the_truth(shift: float, angle: float) -> Guess:
    moved = torch.tensor([0.6 * shift, -0.4 * shift, 0.5 * shift, 0.4 * angle, -0.5 * angle, 0.3 * angle])
    return Guess(poses.retract(TRUTH, moved.double()).numpy(), np.full(3, shift), angle=angle)


def drawn(added: float, masked: bool = False, **settings: float) -> tuple[Scene, dict[str, Tensor]]:
    """A scene, and noise-free images of its camera at the true pose in front of a wall 3 m away."""
    robot = load_robot("panda", tip="panda_hand")
    prior = prior_from_guess(near_the_truth(0.03, 0.05))
    angles = [np.array(q) for q in POSTURES]
    images = []
    for q in angles:
        renderer = RayCaster(robot.as_part(q))
        small = renderer.images(CAMERA.binned(2), poses.inverse(TRUTH)[None])[0]
        image = np.where(np.isfinite(small), small + added, 3.0)
        images.append(np.kron(image, np.ones((2, 2))))  # binned again by the scene
    masks = [image < 2.9 for image in images] if masked else None
    scene = prepare(robot, CAMERA, prior, angles, images, masks, bins=2, **settings)
    return scene, dict(observations(scene, images, masks))


def log_likelihood(scene: Scene, seen: dict[str, Tensor], camera: Tensor, bias: float) -> Tensor:
    given = {"camera": camera, "bias": torch.full((len(camera),), bias, dtype=torch.float64)}
    trace, _ = generate(arm_in_view, (scene, len(seen)), seen, len(camera), given)
    return trace.log_prob(*seen)


def test_the_truth_is_the_likeliest_with_its_own_bias() -> None:
    scene, seen = drawn(0.02, widening=0.0)
    steps = torch.cat([torch.diag(torch.tensor([0.01] * 3 + [0.02] * 3)), torch.zeros(1, 6)]).double()
    moved = poses.retract(TRUTH, torch.cat([steps, -steps[:6]]))
    likelihood = log_likelihood(scene, seen, moved, 0.02)
    assert int(likelihood.argmax()) == 6
    assert float(likelihood[6]) > float(log_likelihood(scene, seen, TRUTH[None], 0.0))


@pytest.mark.long
def test_camera_and_bias_are_estimated_jointly() -> None:
    scene, seen = drawn(0.012, widening=0.0, effective_pixels=1000.0)
    torch.manual_seed(0)
    population = importance_sampling(arm_in_view, (scene, 2), seen, 200, fitted_proposal(scene, seen))
    off = poses.local(TRUTH, population.belief("camera").mean)
    before = poses.local(TRUTH, torch.from_numpy(near_the_truth(0.03, 0.05).world_from_part))
    assert float(off[:3].norm()) < 0.01 < 0.5 * float(before[:3].norm()) + 0.01
    assert math.degrees(float(off[3:].norm())) < 1.0


MASKED = {"mask_width": 2.0, "mask_temperature": 20.0, "inside": 0, "effective_inside": 10.0, "bias": 0.02}


def test_masks_locate_the_camera_whatever_the_range_bias() -> None:
    scene, seen = drawn(0.012, masked=True, **MASKED)
    assert set(seen) == {"depth_0", "depth_1", "mask_0", "mask_1"}
    steps = torch.diag(torch.tensor([0.02] * 3 + [0.02] * 3)).double()
    moved = poses.retract(TRUTH, torch.cat([torch.zeros(1, 6).double(), steps, -steps]))
    given = {"camera": moved, "bias": torch.zeros(13).double(), "rim": torch.zeros(13).double()}
    trace, _ = generate(arm_in_view, (scene, 2), seen, 13, given)
    assert int(trace.log_prob("mask_0", "mask_1").argmax()) == 0


def test_the_fitted_proposal_is_near_the_posterior() -> None:
    scene, seen = drawn(0.012, masked=True, **MASKED)
    torch.manual_seed(0)
    population = importance_sampling(
        arm_in_view, (scene, 2), seen, 200, fitted_proposal(scene, seen, draws=200)
    )
    assert population.effective_sample_size > 20.0
    belief = population.belief("camera")
    off = poses.local(TRUTH, belief.mean)
    assert bool((off.abs() < 3.0 * belief.spread).all())
    assert float(off[:3].norm()) < 0.03 and math.degrees(float(off[3:].norm())) < 1.5


def test_masks_that_do_not_fit_are_refused() -> None:
    scene, _ = drawn(0.0)
    robot, angles = load_robot("panda", tip="panda_hand"), [np.array(q) for q in POSTURES]
    images = [np.ones((72, 96))] * 2
    with pytest.raises(
        InputError, match=r"2 views are given masks of shapes \[\(72, 96\)\]; give one for each"
    ):
        prepare(robot, CAMERA, scene.prior, angles, images, images[:1])
    with pytest.raises(
        InputError, match=r"\(72, 96\), \(96, 72\)\]; give one for each, .* \(72, 96\), or none"
    ):
        prepare(robot, CAMERA, scene.prior, angles, images, [images[0], images[0].T])


def test_a_part_is_dilated_on_all_sides() -> None:
    ball = trimesh.creation.icosphere(3, 0.1)
    loose = Part(
        "ball", ball.vertices[ball.faces].reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3)
    )
    wider = widened(loose, 0.005)
    assert np.allclose(np.linalg.norm(wider.vertices, axis=1), 0.105, atol=1e-5)
    assert wider.mesh.is_watertight


@needed
def test_real_images_are_likelier_with_a_dilated_foreground() -> None:
    """At the reference pose, with the arm dilated by half a matching window of the stereo sensor."""
    optical = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    body = np.load(XARM / "HT_base_cam.npy").astype(np.float64)
    turn, _, back = np.linalg.svd(body[:3, :3] @ optical.T)
    there = poses.from_rotation_matrix(torch.from_numpy(body[:3, 3]), torch.from_numpy(turn @ back))
    camera = Camera("d", 1280, 720, 908.302, 908.293, 642.962, 372.732, poses.identity().numpy(), 0.3, 10.0)
    robot = Robot(XARM / "xarm7_plain.urdf")
    angles = [np.load(XARM / f"joint_state_{k}.npy") for k in (0, 3)]
    images = [1e-3 * np.asarray(Image.open(XARM / f"depth_{k}.png")).astype(np.float64) for k in (0, 3)]
    prior = prior_from_guess(Guess(there.numpy(), np.full(3, 0.05), angle=0.09))
    likelihood = []
    for by in (0.0, 0.0055):
        scene = prepare(robot, camera, prior, angles, images, widening=by, effective_pixels=None)
        seen = dict(observations(scene, images))
        likelihood.append(log_likelihood(scene, seen, there[None], 0.01))
    assert float(likelihood[1] - likelihood[0]) > 50.0


def test_the_static_background_is_estimated_from_the_other_views() -> None:
    """The depth behind the arm is that of the other views, robust to one wrong reading."""
    views = [np.full((1, 4), 2.0) for _ in range(4)]
    views[0][0, 0] = 1.0  # the arm, here only
    views[1][0, 0] = 9.0  # a wrong reading
    views[2][0, 1] = views[3][0, 1] = 1.0  # the arm, in two of the others
    views[1][0, 2] = views[2][0, 2] = views[3][0, 2] = np.nan
    views[1][0, 3] = views[2][0, 3] = np.nan
    behind = background_of(views, 0)
    assert behind[0, 0] == 2.0 and behind[0, 1] == 1.0 and np.isnan(behind[0, 2]) and behind[0, 3] == 2.0
    assert np.isnan(background_of(views[:1], 0)).all()


def test_nothing_is_written_into_the_scene() -> None:
    scene, seen = drawn(0.0, masked=True)
    before = contents(scene)
    views = len(scene.renderers)
    torch.manual_seed(0)
    importance_sampling(arm_in_view, (scene, views), seen, 5, fitted_proposal(scene, seen, draws=20))
    assert len(before) > 40 and contents(scene) == before
