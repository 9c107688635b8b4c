"""A scene of a BOP data set: where its files are, its cameras and its ground truth.

The published layout, of which SCENE is one folder `SPLIT/000001`:

    DATASET/models/obj_000001.ply, models_info.json   vertices and sizes in mm
    DATASET/SPLIT/000001/scene_camera.json            of each frame cam_K, depth_scale (mm per count) and,
                                                      where they are known, cam_R_w2c, cam_t_w2c (mm)
    DATASET/SPLIT/000001/scene_gt.json                of each frame a list: obj_id, cam_R_m2c, cam_t_m2c (mm)
    DATASET/SPLIT/000001/depth/000003.png (or .tif)
    DATASET/SPLIT/000001/rgb/000003.png (or .jpg)

`models` has variants (`models_cad`; `models_eval`, decimated, from which BOP computes errors, and which is
preferred); with several sensors `scene_camera`, `scene_gt`, `depth`
and `rgb` end in `_SENSOR`. `camera.json` at the level of the data set is for simulation, and is not read.

The flat layout, a single scene on its own: `camera.json`, `scene_gt.json`, `depth_000003.png`,
`rgb_000003.png` and `models_eval/` in one folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bcppl.arrays import Array
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.poses import from_rotation_matrix, inverse
from bcppl.recordings.importers.bop.images import COLOURS, DEPTHS
from bcppl.untrusted import strict_json

MOST = 1e9  # of any number in the files
REMEDY = "give the folder of one BOP scene, such as DATASET/test/000001"
_FEW = 12  # numbers that a message lists


@dataclass(frozen=True, eq=False)
class Optics:
    """What is stated of a frame's camera.

    Attributes:
        matrix: (3, 3), pixels.
        scale: of the depth image, millimetres per count.
        world_from_camera: (7,) metres; None where it is not stated.
    """

    matrix: Array
    scale: float
    world_from_camera: Array | None


class Scene:
    """A scene in the published layout.

    Args:
        folder: of the scene.
        sensor: of several, or "".
        models: the folder of meshes in the data set; None for the first that there is.
    """

    def __init__(self, folder: Path, sensor: str = "", models: str | None = None) -> None:
        self.folder, self._models = folder, models
        self._ending = f"_{sensor}" if sensor else ""
        self.truth_file = folder / f"scene_gt{self._ending}.json"

    @cached_property
    def truths(self) -> dict[str, Any]:
        """The content of the ground truth, by the frames' numbers as text."""
        return _by_frame(self.truth_file)

    def frames(self, annotated: bool) -> list[int]:
        """The numbers of the frames, in order: of those with ground truth, or of those with a camera."""
        return sorted(map(int, self.truths if annotated else self._cameras))

    def instances(self, frame: int, object_id: int) -> list[Array]:
        """The poses (7,) of an object's instances in a frame, `camera_from_part`, metres, as they are listed.

        Raises:
            InputError: the frame is not laid out as one of BOP, or the object is not in it.
        """
        entries = self.truths.get(str(frame))
        if not isinstance(entries, list) or not all(_has_id(each) for each in entries):
            what = (
                f"{self.folder} is not laid out as a BOP scene (in {self.truth_file} an object has no obj_id)"
            )
            raise InputError(f"{what}; compare its files with the format.")
        ids = sorted({each["obj_id"] for each in entries})
        if object_id not in ids:
            raise InputError(f"{self.folder} holds no object {object_id}; give --object one of {_few(ids)}.")
        mine = [each for each in entries if each["obj_id"] == object_id]
        return [_pose(each, "cam_R_m2c", "cam_t_m2c", self.truth_file) for each in mine]

    def optics(self, frame: int) -> Optics:
        """What is stated of a frame's camera.

        Raises:
            InputError: it is missing, or no pinhole camera.
        """
        file, entry = self._camera_file, self._cameras.get(str(frame))
        if not isinstance(entry, dict):
            raise InputError(f"{file} has no camera of frame {frame}; copy it again.")
        pose = None
        if "cam_R_w2c" in entry or "cam_t_w2c" in entry:
            camera_from_world = torch.from_numpy(_pose(entry, "cam_R_w2c", "cam_t_w2c", file))
            pose = inverse(camera_from_world).numpy()
        scale = numbers({"depth_scale": [entry.get("depth_scale")]}, "depth_scale", 1, file)
        return Optics(_intrinsics(entry, file), float(scale[0]), pose)

    def depth(self, frame: int) -> Path:
        """The file of a frame's depth image."""
        return _first(self.folder / f"depth{self._ending}", f"{frame:06d}", list(DEPTHS))

    def colour(self, frame: int) -> Path:
        """The file of a frame's colour image, which need not be there."""
        return _first(self.folder / f"rgb{self._ending}", f"{frame:06d}", list(COLOURS))

    def mesh(self, object_id: int) -> Path:
        """The file of an object's mesh.

        Raises:
            InputError: there is none.
        """
        data_set = self.folder.resolve().parent.parent
        known = sorted(each.name for each in data_set.glob("models*") if each.is_dir())
        models = self._models or next((n for n in ("models_eval", "models", *known) if n in known), "models")
        path = data_set / models / f"obj_{object_id:06d}.ply"
        if path.is_file():
            return path
        others = f"; give --models one of {', '.join(known)}" if known else "; unpack the models there"
        raise InputError(f"{path} is missing: the data set has no mesh of object {object_id}{others}.")

    @property
    def _camera_file(self) -> Path:
        return self.folder / f"scene_camera{self._ending}.json"

    @cached_property
    def _cameras(self) -> dict[str, Any]:
        return _by_frame(self._camera_file)


class FlatScene(Scene):
    """A scene on its own, of which all frames have the camera of `camera.json`."""

    @property
    def _camera_file(self) -> Path:
        return self.folder / "camera.json"

    @cached_property
    def _cameras(self) -> dict[str, Any]:
        camera = content(self._camera_file)
        return {str(frame): {"depth_scale": 1.0, **camera} for frame in self.truths}

    def depth(self, frame: int) -> Path:
        """The file of a frame's depth image."""
        return self.folder / f"depth_{frame:06d}.png"

    def colour(self, frame: int) -> Path:
        """The file of a frame's colour image, which need not be there."""
        return self.folder / f"rgb_{frame:06d}.png"

    def mesh(self, object_id: int) -> Path:
        """The file of an object's mesh.

        Raises:
            InputError: there is none.
        """
        path = self.folder / (self._models or "models_eval") / f"obj_{object_id:06d}.ply"
        if not path.is_file():
            raise InputError(f"{path} is missing: the scene has no mesh of object {object_id}; put it there.")
        return path


def scene_in(folder: Path, sensor: str, models: str | None) -> Scene:
    """The scene in a folder, in the layout that its files have."""
    published = Scene(folder, sensor, models)
    if published._camera_file.is_file() or published.depth(0).parent.is_dir() or sensor:
        return published
    return FlatScene(folder, sensor, models)


def content(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        InputError: it is missing, or no JSON, or something else.
    """
    held = strict_json.read(path, REMEDY)
    if not isinstance(held, dict):
        raise InputError(f"{path} holds no object of JSON; {REMEDY}.")
    return held


def numbers(entry: dict[str, Any], name: str, count: int, path: Path) -> Array:
    """The numbers (count,) of a name in a file.

    Raises:
        InputError: it is missing, or something else.
    """
    held = entry.get(name)
    values = held if isinstance(held, list) else []
    if len(values) != count or not all(type(each) in (int, float) and abs(each) < MOST for each in values):
        raise InputError(f"{path} needs a {name} of {count} number{'s' * (count > 1)}; copy it again.")
    return np.asarray(values, dtype=np.float64)


def listed(frames: Sequence[int]) -> str:
    """Numbers of frames, for a message."""
    return _few(frames) or "none"


def _few(values: Sequence[int]) -> str:
    if len(values) <= _FEW:
        return ", ".join(map(str, values))
    return f"{', '.join(map(str, values[: _FEW - 2]))} ... {values[-1]} ({len(values)} of them)"


def _by_frame(path: Path) -> dict[str, Any]:
    held = content(path)
    if strange := [name for name in held if not (name.isascii() and name.isdecimal() and len(name) < 10)]:
        raise InputError(f"{path} has a frame {strange[0][:40]!r}; name frames by their numbers.")
    return held


def _has_id(entry: object) -> bool:
    return isinstance(entry, dict) and type(entry.get("obj_id")) is int


def _pose(entry: dict[str, Any], rotation_name: str, translation_name: str, path: Path) -> Array:
    """The pose (7,), metres, of a rotation matrix row by row and a translation in mm."""
    rotation = numbers(entry, rotation_name, 9, path).reshape(3, 3)
    moved = 1e-3 * numbers(entry, translation_name, 3, path)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.02 or np.linalg.det(rotation) < 0:
        raise InputError(f"{path} has a {rotation_name} that is no rotation; copy it again.")
    # It is printed with eight digits, and orthogonal to that.
    left, _, right = np.linalg.svd(rotation)
    return from_rotation_matrix(torch.from_numpy(moved), torch.from_numpy(left @ right)).numpy()


def _intrinsics(entry: dict[str, Any], path: Path) -> Array:
    matrix = numbers(entry, "cam_K", 9, path).reshape(3, 3)
    if np.abs(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0.0, 0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise InputError(
            f"{path} has a cam_K with a skew, or whose last row is not 0 0 1; rectify the image."
        )
    return matrix


def _first(folder: Path, stem: str, endings: Sequence[str]) -> Path:
    """The file with the first of the endings that there is; the first of all if there is none."""
    paths = [folder / f"{stem}{ending}" for ending in endings]
    return next((path for path in paths if path.is_file()), paths[0])
