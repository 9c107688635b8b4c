"""Importers on real recordings: their numbers are those that were measured when the data were collected."""

import math
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import typer
from typer.testing import CliRunner

from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.poses import inverse, local, rotation_matrix, transform
from bcppl.recordings import DepthImage, Push, Recording, Touch, View, load, notes, problems, save
from bcppl.recordings.importers import bop, importers, point_probe

DATA = Path(__file__).parents[4] / "shared/data"
SCENE = DATA / "lmo_scene2_frame3"
SHIPPED = Path(__file__).parents[3] / "models/recordings/point_probe_10_pushes.h5"

pushes_needed = pytest.mark.skipif(
    not (DATA / "point_probe_pushes").is_dir(), reason=f"the push logs are not in {DATA}"
)
scene_needed = pytest.mark.skipif(not SCENE.is_dir(), reason=f"the BOP scene is not in {DATA}")


def logs() -> list[Path]:
    return sorted((DATA / "point_probe_pushes").glob("*exp*.txt"))


def test_importers_are_found_by_name() -> None:
    assert list(importers()) == ["bag", "bench", "bop", "fmb", "point-probe", "reassemble"]
    assert all(module.HELP and callable(module.command) for module in importers().values())


# ---- pushes


def contacts(recording: Recording) -> tuple[Any, Any]:
    """At each push's onset: the tip (K, 3) and the tared force on the part (K, 3), in the part's frame."""
    assert recording.truth is not None
    truth = torch.from_numpy(recording.truth)
    turn = rotation_matrix(truth).numpy()
    tips, forces = [], []
    for measurement in recording.measurements:
        push, touch = measurement.action, measurement.observation
        assert isinstance(push, Push) and isinstance(touch, Touch)
        tared = touch.wrench - touch.wrench[:10].mean(axis=0)
        onset = int(np.argmax(np.linalg.norm(tared[:, :3], axis=1) > 0.6))
        tip = [np.interp(touch.times[onset], push.times, push.world_from_tip[:, k]) for k in range(3)]
        tips.append(transform(inverse(truth), torch.tensor([tip], dtype=torch.float64))[0].numpy())
        forces.append(-tared[onset, :3] @ turn)
    return np.array(tips), np.array(forces)


def outline(points: Any) -> tuple[Any, Any]:
    """Signed distances (K,) to the triangle's outline, positive outside; the nearest edge's inward normal."""
    corners = 0.15 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    ends = np.roll(corners, -1, axis=0)
    along = (ends - corners) / np.linalg.norm(ends - corners, axis=1, keepdims=True)
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    outside = -np.einsum("kes,es->ke", points[:, None] - corners, inward)
    nearest = outside.argmax(axis=1)
    return outside.max(axis=1), inward[nearest]


@pushes_needed
def test_both_logs_meet_the_prism_where_they_should() -> None:
    recording = point_probe.command(logs(), pushes=100, seed=3)
    assert problems(recording) == []
    tips, forces = contacts(recording)
    distance, inward = outline(tips[:, :2])
    assert len(distance) == 100
    assert np.mean(distance) == pytest.approx(-0.6e-3, abs=0.05e-3)
    assert np.std(distance) == pytest.approx(0.6e-3, abs=0.05e-3)
    assert np.abs(distance).max() < 2.4e-3
    assert tips[:, 2].min() > 0.005 and tips[:, 2].max() < 0.02  # the prism stands from 0 to 50 mm
    pressing = np.einsum("ks,ks->k", forces[:, :2], inward)
    sideways = inward[:, 0] * forces[:, 1] - inward[:, 1] * forces[:, 0]
    angle = np.degrees(np.arctan2(sideways, pressing))
    assert np.abs(angle).max() < 27  # the friction cone: every force presses inwards
    for side in (angle > 0, angle < 0):
        assert 40 <= side.sum() <= 60
        assert 18 < np.percentile(np.abs(angle[side]), 75) < 26


@pushes_needed
def test_pushes_are_pooled_at_a_known_pose_in_the_prior() -> None:
    truths = []
    for seed in range(20):
        recording = point_probe.command(logs()[:1], pushes=1, seed=seed, translation=0.01, yaw=15)
        assert recording.truth is not None
        tangent = local(torch.from_numpy(recording.guess.world_from_part), torch.from_numpy(recording.truth))
        truths.append((tangent / torch.tensor([0.01, 0.01, 1, 1, 1, math.radians(15)])).numpy())
    spread = np.array(truths)
    assert np.abs(spread[:, [2, 3, 4]]).max() < 1e-12
    assert np.abs(spread[:, [0, 1, 5]]).max() <= 1 and (np.abs(spread[:, [0, 1, 5]]).max(axis=0) > 0.8).all()
    np.testing.assert_array_equal(recording.guess.translation, [0.01, 0.01, 0])
    assert recording.guess.yaw == math.radians(15) and recording.guess.tilt == 0


@pushes_needed
def test_a_push_is_cut_after_its_contact_and_not_tared() -> None:
    short, long = (point_probe.command(logs(), pushes=5, seed=1, after=after) for after in (0.5, 60.0))
    for cut, whole in zip(short.measurements, long.measurements, strict=True):
        assert isinstance(cut.observation, Touch) and isinstance(whole.observation, Touch)
        assert isinstance(cut.action, Push)
        rows = len(cut.observation.times)
        np.testing.assert_array_equal(cut.observation.wrench, whole.observation.wrench[:rows])
        tared = cut.observation.wrench - cut.observation.wrench[:10].mean(axis=0)
        onset = np.argmax(np.linalg.norm(tared, axis=1) > 0.6)
        assert 0.47 < cut.observation.times[-1] - cut.observation.times[onset] <= 0.5
        assert cut.action.times[-1] >= cut.observation.times[-1]
        assert cut.observation.world_from_peg.shape == (0, 7)


def test_bad_logs_are_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    tip = "0 0 0 1 0 0 0"
    push = f"{tip} {tip} 12 {'0 0 0 ' * 12} 1 0 {tip} "
    for content, what in (
        ("one push", "whitespace-separated numbers"),
        ("2 " + push, "middle of a push"),
        ("1 " + push[:-30], "middle of a push"),
        ("1 " + push + push, "more numbers"),
        ("1 " + push.replace(" 12 ", " 2 ", 1), "too few rows|more numbers|middle"),
        ("1 " + push, "holds 0 with a contact"),
        ("1 " + push.replace("12 0 0 0", "12 0 0 nan"), "not finite"),
        ("1 " + push.replace("1 0 0 0", "2 0 0 0", 1), "unit length"),
        ("", "middle of a push"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=what) as failure:
            point_probe.command([path])
        assert "log.txt" in str(failure.value) and "\n" not in str(failure.value)
    with pytest.raises(InputError, match="missing"):
        point_probe.command([tmp_path / "missing.txt"])


@pushes_needed
def test_more_pushes_than_there_are_are_refused() -> None:
    with pytest.raises(InputError, match=r"51 pushes .* between 1 and 50\.$"):
        point_probe.command(logs()[:1], pushes=51)


@pytest.mark.parametrize("module", importers().values())
def test_commands_are_understood_by_typer(module: Any) -> None:
    application = typer.Typer()
    application.command()(module.command)
    shown = CliRunner().invoke(application, ["--help"], env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert shown.exit_code == 0
    for name in signature(module.command).parameters.keys() & {"seed", "translation", "frame"}:
        assert f"--{name}" in shown.output


@pushes_needed
def test_the_shipped_recording_can_be_made_again(tmp_path: Path) -> None:
    (log,) = (path for path in logs() if path.name.startswith("10_90_"))
    save(point_probe.command([log], pushes=10, seed=0), tmp_path / "again.h5")
    again, shipped = load(tmp_path / "again.h5"), load(SHIPPED)
    assert again.truth is not None and shipped.truth is not None
    np.testing.assert_allclose(again.truth, shipped.truth, atol=1e-12)
    for ours, theirs in zip(again.measurements, shipped.measurements, strict=True):
        assert isinstance(ours.observation, Touch) and isinstance(theirs.observation, Touch)
        np.testing.assert_allclose(ours.observation.wrench, theirs.observation.wrench, atol=1e-12)


def test_the_shipped_recording_is_sound_and_attributed() -> None:
    recording = load(SHIPPED)
    assert problems(recording) == [] and len(recording.measurements) == 10
    assert recording.part.mesh.volume == pytest.approx(0.15**2 / 2 * 0.05)
    assert "R. Zhou" in recording.source and "Apache-2.0" in recording.source
    distance, _ = outline(contacts(recording)[0][:, :2])
    assert np.abs(distance).max() < 2.4e-3
    assert "Apache License" in (SHIPPED.parent / "LICENSE-point-probe").read_text()
    assert SHIPPED.stat().st_size < 400_000


# ---- BOP


def rendered(part: Part, world_from_part: Any, view: View) -> Any:
    """Depth (H, W) of the part alone, NaN where there is none; only rays near it are cast."""
    camera = view.camera
    pose = torch.from_numpy(world_from_part)
    corners = transform(pose, torch.from_numpy(part.vertices)).numpy()
    u = camera.fx * corners[:, 0] / corners[:, 2] + camera.cx
    v = camera.fy * corners[:, 1] / corners[:, 2] + camera.cy
    rays = camera.rays().reshape(camera.height, camera.width, 3)
    rows = slice(int(v.min()), int(v.max()) + 2)
    columns = slice(int(u.min()), int(u.max()) + 2)
    block = rays[rows, columns].reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, part.faces, process=False)
    points, hit, _ = mesh.ray.intersects_location(np.zeros_like(block), block, multiple_hits=False)
    depth = np.full((camera.height, camera.width), np.nan)
    patch = np.full(len(block), np.nan)
    patch[hit] = points[:, 2]
    depth[rows, columns] = patch.reshape(depth[rows, columns].shape)
    return depth


@scene_needed
@pytest.mark.parametrize(
    ("object_id", "median", "valid", "visible"), [(5, 6.5e-3, 4283, 4165), (8, 3.4e-3, 5180, 5107)]
)
def test_the_truth_explains_the_depth_image(object_id: int, median: float, valid: int, visible: int) -> None:
    recording = bop.command(SCENE, object_id)
    assert problems(recording) == [] and notes(recording) == []
    action, image = recording.measurements[0].action, recording.measurements[0].observation
    assert isinstance(action, View) and isinstance(image, DepthImage)
    residual = image.depth - rendered(recording.part, recording.truth, action)
    covered = residual[np.isfinite(residual)]
    seen = covered[covered > -15e-3]  # BOP's rule: what lies further in front hides the object
    # The pixel counts of the scene's own scene_gt_info.json, made by another renderer.
    assert len(covered) == pytest.approx(valid, rel=0.005)
    assert len(seen) == pytest.approx(visible, rel=0.025)
    assert np.median(seen) == pytest.approx(median, abs=0.5e-3)
    assert np.median(np.abs(seen - np.median(seen))) < 3.2e-3
    assert np.isnan(image.depth).any() and image.rgb is not None and image.rgb.shape == (480, 640, 3)


@scene_needed
def test_every_object_comes_back_from_disk_as_it_was(tmp_path: Path) -> None:
    for object_id, diameter in ((1, 0.102099), (10, 0.164628)):
        recording = bop.command(SCENE, object_id, seed=object_id)
        assert problems(recording) == []
        assert recording.part.diameter == pytest.approx(diameter, rel=0.01)
        save(recording, tmp_path / "a.h5")
        loaded = load(tmp_path / "a.h5").measurements[0].observation
        saved = recording.measurements[0].observation
        assert isinstance(loaded, DepthImage) and isinstance(saved, DepthImage)
        np.testing.assert_array_equal(loaded.depth, saved.depth)
    assert "open mesh" in notes(recording)[0]  # object 10 has a hole in its mesh


@scene_needed
def test_an_unknown_object_lists_those_present() -> None:
    with pytest.raises(InputError, match=r"no object 7; give --object one of 1, 5, 8, 10\.$"):
        bop.command(SCENE, 7)
    with pytest.raises(InputError, match=r"no frame 4; give --frame one of 3\.$"):
        bop.command(SCENE, 5, frame=[4])


def test_a_folder_that_is_no_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"scene_gt\.json is missing"):
        bop.command(tmp_path, 5)
    (tmp_path / "scene_gt.json").write_text('{"3": [{"cam_t_m2c": [0, 0, 1]}]}')
    with pytest.raises(InputError, match=r"not laid out as a BOP scene .*obj_id"):
        bop.command(tmp_path, 5)


@scene_needed
def test_the_truth_lies_in_the_prior_about_the_guess() -> None:
    recording = bop.command(SCENE, 5, seed=4, translation=0.03, angle=10)
    assert recording.truth is not None
    tangent = local(torch.from_numpy(recording.guess.world_from_part), torch.from_numpy(recording.truth))
    np.testing.assert_allclose(tangent.numpy(), bop.draw(4, 0.03, math.radians(10)), atol=1e-9)


def test_guesses_are_uniform_in_the_box_and_by_haar_within_the_angle() -> None:
    limit = math.radians(170)
    draws = np.array([bop.draw(seed, 0.04, limit) for seed in range(2000)])
    angle = np.linalg.norm(draws[:, 3:], axis=1)
    # Under the Haar measure P(angle < a) is (a - sin a) / pi, scaled to the limit; uniform angles fail.
    fraction = np.sort((angle - np.sin(angle)) / (limit - math.sin(limit)))
    assert np.abs(fraction - (np.arange(2000) + 0.5) / 2000).max() < 1.95 / math.sqrt(2000)
    assert np.abs(draws[:, 3:].mean(axis=0)).max() < 0.15
    assert np.abs(draws[:, :3]).max() <= 0.04
    np.testing.assert_allclose(draws[:, :3].std(axis=0), 0.04 / math.sqrt(3), rtol=0.05)
