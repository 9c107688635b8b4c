"""BOP scenes in the published layout, written by hand: what is imported is what was written, in SI units."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from bcppl.errors import InputError
from bcppl.recordings import DepthImage, View, load, problems, save
from bcppl.recordings.importers import bop

LMO = Path(__file__).parents[4] / "shared/data/lmo_scene2_frame3"
K = [600.0, 0.0, 31.5, 0.0, 610.0, 23.5, 0.0, 0.0, 1.0]
# Two instances of object 7 in the world, mm, and the world's poses seen by three cameras (w2c).
INSTANCES = (
    (Rotation.from_rotvec([0.1, 0.2, 0.9]), np.array([30.0, -20.0, 12.0])),
    (Rotation.from_rotvec([-0.4, 0.1, 0.3]), np.array([-110.0, 60.0, 15.0])),
)
CAMERAS = {
    0: (Rotation.from_rotvec([2.8, 0.3, 0.1]), np.array([10.0, 20.0, 700.0])),
    4: (Rotation.from_rotvec([2.6, -0.4, 0.2]), np.array([-35.0, 5.0, 640.0])),
    11: (Rotation.from_rotvec([2.9, 0.0, -0.5]), np.array([0.0, 40.0, 810.0])),
}


def write(root: Path, world: bool = True, sensor: str = "", ending: str = ".png") -> Path:
    """A data set with one scene; its depth images count 0.1 mm, and are 7001 + 10 v + u counts deep."""
    scene, suffix = root / "ds/test/000002", f"_{sensor}" if sensor else ""
    for folder in (scene / f"depth{suffix}", scene / f"rgb{suffix}", root / "ds/models"):
        folder.mkdir(parents=True)
    (root / "ds/camera.json").write_text(json.dumps({"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}))
    cameras, truths = {}, {}
    for frame, (turn, shift) in CAMERAS.items():
        entry: dict[str, Any] = {"cam_K": K, "depth_scale": 0.1}
        if world:
            entry |= {"cam_R_w2c": turn.as_matrix().ravel().tolist(), "cam_t_w2c": shift.tolist()}
        cameras[str(frame)] = entry
        seen = [
            {
                "obj_id": 7,
                "cam_R_m2c": (turn * r).as_matrix().ravel().tolist(),
                "cam_t_m2c": (turn.apply(t) + shift).tolist(),
            }
            for r, t in INSTANCES
        ]
        truths[str(frame)] = seen[:: -1 if frame == 4 else 1]  # listed in another order in one frame
        v, u = np.mgrid[0:48, 0:64]
        counts = (7001 + 10 * v + u).astype(np.uint16)
        counts[5, 6] = 0
        Image.fromarray(counts).save(scene / f"depth{suffix}/{frame:06d}{ending}")
        Image.fromarray(np.full((48, 64, 3), frame, np.uint8)).save(scene / f"rgb{suffix}/{frame:06d}.png")
    (scene / f"scene_camera{suffix}.json").write_text(json.dumps(cameras))
    (scene / f"scene_gt{suffix}.json").write_text(json.dumps(truths))
    mesh = trimesh.creation.box((80.0, 50.0, 30.0))
    mesh.export(root / "ds/models/obj_000007.ply", encoding="ascii")
    info = {"7": {"diameter": 98.99, "size_x": 80.0, "size_y": 50.0, "size_z": 30.0}}
    (root / "ds/models/models_info.json").write_text(json.dumps(info))
    return scene


def matrix(pose: Any) -> Any:
    """The homogeneous matrix (4, 4) of a pose (7,)."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix(), pose[:3]
    return made


def homogeneous(turn: Rotation, shift: Any) -> Any:
    """The matrix (4, 4) in metres of a rotation and a translation in mm."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = turn.as_matrix(), 1e-3 * shift
    return made


@pytest.mark.parametrize(("sensor", "ending"), [("", ".png"), ("photoneo", ".tif")])
def test_several_frames_are_views_from_cameras_in_the_world(tmp_path: Path, sensor: str, ending: str) -> None:
    scene = write(tmp_path, sensor=sensor, ending=ending)
    recording = bop.command(scene, 7, frame=[0, 4, 11], instance=1, sensor=sensor, seed=3)
    assert problems(recording) == []
    # The second instance of frame 0 is the first that frame 4 lists.
    np.testing.assert_allclose(matrix(recording.truth), homogeneous(*INSTANCES[1]), atol=1e-9)
    for measurement, (frame, pose) in zip(recording.measurements, CAMERAS.items(), strict=True):
        action, image = measurement.action, measurement.observation
        assert isinstance(action, View) and isinstance(image, DepthImage)
        camera = action.camera
        assert (camera.name, camera.instrument) == (f"sensor {frame}", "sensor")
        world_from_camera = np.linalg.inv(homogeneous(*pose))
        np.testing.assert_allclose(matrix(camera.world_from_camera), world_from_camera, atol=1e-9)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (600.0, 610.0, 31.5, 23.5)
        assert math.isnan(image.depth[5, 6]) and image.depth.shape == (48, 64)
        assert image.depth[20, 9] == pytest.approx(0.721, abs=1e-7)  # 7210 counts of 0.1 mm
        assert image.rgb is not None and (image.rgb == frame).all()
    np.testing.assert_allclose(recording.part.extent, [0.08, 0.05, 0.03], atol=1e-9)
    save(recording, tmp_path / "again.h5")
    again = load(tmp_path / "again.h5")
    assert again.measurements[1].action.camera.name == "sensor 4"


def test_without_a_world_it_is_the_cameras_and_several_frames_need_one_viewpoint(tmp_path: Path) -> None:
    scene = write(tmp_path, world=False)
    turn, shift = CAMERAS[4]
    recording = bop.command(scene, 7, frame=[4], instance=1, offset="0.01 0 -0.02 0 0 90")
    rotation, place = INSTANCES[0]  # frame 4 lists it second
    expected = homogeneous(turn, shift) @ homogeneous(rotation, place)
    np.testing.assert_allclose(matrix(recording.truth), expected, atol=1e-9)
    np.testing.assert_array_equal(
        matrix(recording.measurements[0].action.camera.world_from_camera), np.eye(4)
    )
    guess = matrix(recording.guess.world_from_part)
    np.testing.assert_allclose(guess[:3, 3] - expected[:3, 3], [0.01, 0.0, -0.02], atol=1e-9)
    quarter = Rotation.from_rotvec([0.0, 0.0, math.pi / 2]).as_matrix()
    np.testing.assert_allclose(guess[:3, :3], expected[:3, :3] @ quarter, atol=1e-9)
    with pytest.raises(InputError, match=r"no cam_R_w2c, and object 7 is seen .* viewpoints are not known"):
        bop.command(scene, 7, frame=[4, 11])
    # A camera that stands still sees the object at one place: its frames are views of one camera.
    file = scene / "scene_gt.json"
    truths = json.loads(file.read_text())
    file.write_text(json.dumps({**truths, "11": truths["4"]}))
    views = bop.command(scene, 7, frame=[4, 11]).measurements
    assert views[0].action.camera is views[1].action.camera


def test_a_stated_guess_needs_no_ground_truth(tmp_path: Path) -> None:
    scene = write(tmp_path)
    (scene / "scene_gt.json").unlink()
    recording = bop.command(scene, 7, frame=[0, 11], guess="0.03 -0.02 0.012 1 0 0 0")
    assert recording.truth is None and len(recording.measurements) == 2
    np.testing.assert_array_equal(recording.guess.world_from_part, [0.03, -0.02, 0.012, 1, 0, 0, 0])
    with pytest.raises(InputError, match=r"scene_gt\.json is missing"):
        bop.command(scene, 7)


def edited(name: str, *keys: Any) -> Callable[[Path, Any], None]:
    """Puts a value at a place in a JSON file of the scene."""

    def edit(scene: Path, value: Any) -> None:
        file = scene / name
        tree = node = json.loads(file.read_text())
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value
        file.write_text(json.dumps(tree))

    return edit


MISTAKES: dict[str, tuple[Callable[[Path, Any], object], Any]] = {
    "cam_K with a skew": (edited("scene_camera.json", "0", "cam_K"), [600, 9, 31, 0, 600, 23, 0, 0, 1]),
    "needs a cam_K of 9 numbers": (edited("scene_camera.json", "0", "cam_K"), K[:8]),
    "needs a depth_scale of 1 number": (edited("scene_camera.json", "0", "depth_scale"), "0.1"),
    "needs a cam_t_w2c of 3 numbers": (edited("scene_camera.json", "0", "cam_t_w2c"), None),
    "cam_R_w2c that is no rotation": (edited("scene_camera.json", "4", "cam_R_w2c"), [1.0] * 9),
    "has no camera of frame 0": (edited("scene_camera.json", "0"), []),
    "cam_R_m2c that is no rotation": (edited("scene_gt.json", "0", 0, "cam_R_m2c"), [0.0] * 9),
    r"holds no object 7; give --object one of 3\.": (
        edited("scene_gt.json", "0"), [{"obj_id": 3, "cam_R_m2c": [], "cam_t_m2c": []}],
    ),
    "object 7 is 300 mm and .* elsewhere in frame 4": (
        edited("scene_gt.json", "4"),
        [{"obj_id": 7, "cam_R_m2c": (CAMERAS[4][0] * INSTANCES[0][0]).as_matrix().ravel().tolist(),
          "cam_t_m2c": (CAMERAS[4][0].apply(INSTANCES[0][1] + [0, 0, 300]) + CAMERAS[4][1]).tolist()}],
    ),
    "obj_000007.ply has a size_x of 80 mm, and models_info.json states 0.08": (
        edited("../../models/models_info.json", "7", "size_x"), 0.08,
    ),
    r"depth.000004\.png is missing": (lambda scene, _: (scene / "depth/000004.png").unlink(), None),
    r"000004\.png .*its mode is L": (
        lambda scene, _: Image.fromarray(np.zeros((48, 64), np.uint8)).save(scene / "depth/000004.png"), None,
    ),
    "of another size than the depth image": (
        lambda scene, _: Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(scene / "rgb/000000.png"), None,
    ),
    r"scene_camera\.json is missing": (lambda scene, _: (scene / "scene_camera.json").unlink(), None),
    "has no mesh of object 7; give --models one of models": (
        lambda scene, _: (scene / "../../models/obj_000007.ply").unlink(), None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", MISTAKES)
def test_damage_is_one_sentence(words: str, tmp_path: Path) -> None:
    scene = write(tmp_path)
    edit, value = MISTAKES[words]
    edit(scene, value)
    with pytest.raises(InputError, match=words) as failure:
        bop.command(scene, 7, frame=[0, 4])
    assert "\n" not in str(failure.value) and str(failure.value).endswith(".")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"instance": 2}, "holds 2 of object 7 in frame 0; give --instance 0 to 1"),
        ({"frame": [3]}, r"no frame 3; give --frame one of 0, 4, 11\.$"),
        ({"offset": "1 2 3"}, "--offset is '1 2 3'; give 6 numbers"),
        ({"guess": "0 0 0 1 0 0 nan"}, "--guess is .*; give 7 numbers"),
        ({"guess": "0 0 0 1 0 0 0", "offset": "0 0 0 0 0 0"}, "both state the guess"),
        ({"sensor": "cam9"}, r"scene_gt_cam9\.json is missing"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        bop.command(write(tmp_path), 7, **options)


@pytest.mark.skipif(not LMO.is_dir(), reason=f"the BOP scene is not in {LMO.parent}")
def test_a_real_scene_is_the_same_in_both_layouts(tmp_path: Path) -> None:
    scene = tmp_path / "lmo/test/000002"
    shutil.copytree(LMO / "models_eval", tmp_path / "lmo/models_eval")
    for kind in ("depth", "rgb"):
        (scene / kind).mkdir(parents=True)
        shutil.copy(LMO / f"{kind}_000003.png", scene / kind / "000003.png")
    shutil.copy(LMO / "scene_gt.json", scene)
    camera = json.loads((LMO / "camera.json").read_text())
    (scene / "scene_camera.json").write_text(json.dumps({"3": camera}))
    flat, published = bop.command(LMO, 5), bop.command(scene, 5)
    np.testing.assert_array_equal(flat.truth, published.truth)
    np.testing.assert_array_equal(flat.guess.world_from_part, published.guess.world_from_part)
    np.testing.assert_array_equal(flat.part.vertices, published.part.vertices)
    for one, other in zip(flat.measurements, published.measurements, strict=True):
        np.testing.assert_array_equal(one.observation.depth, other.observation.depth)
        assert one.action.camera.optics == other.action.camera.optics
