"""Depth images of a bench's cameras: 16 bit PNG, .npy or EXR, each with the pose of its camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.recordings.importers.bench.config import CameraFields, ImageFields, factor
from bcppl.recordings.importers.bench.pose_columns import composed, stated_pose
from bcppl.recordings.importers.bench.resampling import is_known, poses_at
from bcppl.recordings.importers.bench.streams import Stream
from bcppl.sensors import DepthImage, Measurement, View

SLOW = 0.005  # m/s: an image is better taken at rest
_AROUND = 0.01  # s to either side of an image, over which the arm's speed is measured


def read_views(
    name: str, fields: CameraFields, folder: Path, world_from_frame: Stream, report: list[str]
) -> tuple[list[Measurement], dict[str, Array]]:
    """The views of one camera, and its background by name.

    Args:
        name: of the camera.
        fields: its intrinsics, images and pose.
        folder: that the files' paths are relative to.
        world_from_frame: the poses (T, 7) of the robot's frame, on the pose's clock.
        report: to which a line is added.

    Raises:
        InputError: an image cannot be read, is of another size than others, or was taken when no pose was.
    """
    views: list[Measurement] = []
    shape: tuple[int, ...] | None = None
    missing, fastest = 0.0, 0.0
    for k, image in enumerate(fields.images):
        depth = read_depth(folder / image.file, fields)
        if shape is not None and depth.shape != shape:
            raise InputError(
                f"cameras.{name}: image {image.file} has {depth.shape[1]} x {depth.shape[0]} pixels, those "
                f"before {shape[1]} x {shape[0]}; make another camera of it, with its own intrinsics."
            )
        shape, missing = depth.shape, missing + float(np.isnan(depth).mean()) / len(fields.images)
        where = f"cameras.{name}.images[{k}]"
        camera, speed = _camera(name, where, fields, image, depth.shape, world_from_frame)
        fastest = max(fastest, speed)
        views.append(Measurement(View(camera), DepthImage(depth)))
    moving = f"; the arm moved at up to {1000 * fastest:.0f} mm/s" if fastest > SLOW else ""
    report.append(
        f"camera {name}: {len(views)} image{'' if len(views) == 1 else 's'}, {100 * missing:.0f} % of the "
        f"pixels missing{moving}"
    )
    background = {}
    if fields.background is not None:
        seen = read_depth(folder / fields.background, fields)
        background = {view.action.camera.name: seen for view in views}
    return views, background


def read_depth(path: Path, fields: CameraFields) -> Array:
    """A depth image (H, W) in metres, NaN where missing; rounded to float32, as recordings keep it.

    Raises:
        InputError: the file is missing, of another kind, or holds no image of one channel.
    """
    if not path.is_file():
        raise InputError(f"there is no depth image {path}; give its path relative to the configuration.")
    scale = factor(fields.unit) if fields.unit is not None else fields.scale
    assert scale is not None
    depth = scale * _pixels(path)
    depth[~np.isfinite(depth) | (depth <= 0.0)] = np.nan
    middle = float(np.nanmedian(depth)) if np.isfinite(depth).any() else np.nan
    if not fields.near / 3.0 <= middle <= 3.0 * fields.far:
        raise InputError(
            f"{path} has a median depth of {middle:.4g} m, for a camera that sees from {fields.near:g} to "
            f"{fields.far:g} m; state the unit of its depth."
        )
    return np.asarray(depth.astype(np.float32).astype(np.float64))


def _pixels(path: Path) -> Array:
    kind = path.suffix.lower()
    if kind == ".exr":
        pixels: Any = _exr(path)
    elif kind == ".npy":
        try:
            pixels = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path} holds no plain numbers; save it again.") from error
    elif kind in (".png", ".tif", ".tiff"):
        try:
            with Image.open(path) as image:
                pixels = np.asarray(image)
        except OSError as error:
            raise InputError(
                f"{path} is no image ({error}); export the depth again as 16 bit PNG."
            ) from error
        if pixels.dtype == np.uint8:
            raise InputError(f"{path} has 8 bits, too few for a depth; export it as 16 bit PNG or .npy.")
    else:
        raise InputError(f"{path} ends in {kind!r}; give a depth image as .png (16 bit), .npy or .exr.")
    if pixels.ndim != 2 or pixels.dtype.kind not in "iuf":
        raise InputError(f"{path} holds {pixels.dtype} of shape {pixels.shape}; give one channel of depth.")
    return np.asarray(pixels, dtype=np.float64)


def _exr(path: Path) -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(
            f"{path} is an EXR image, which needs OpenEXR: pip install 'bcppl[bench]'; or save it as .npy."
        ) from error
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the library's own
        raise InputError(f"{path} cannot be read as EXR ({error}); save it again.") from error
    for name in ("Z", "Y", "R", "depth.Z"):
        if name in channels:
            return channels[name]
    if len(channels) == 1:
        return next(iter(channels.values()))
    raise InputError(f"{path} has the channels {', '.join(channels)}; save the depth as channel Z.")


def _camera(
    name: str,
    where: str,
    fields: CameraFields,
    image: ImageFields,
    shape: tuple[int, ...],
    world_from_frame: Stream,
) -> tuple[Camera, float]:
    """The camera of one image, and the arm's speed (m/s) when it was taken."""
    stands = fields.world_from_camera
    hand_eye = fields.frame_from_camera
    camera = Camera(
        name,
        width=shape[1],
        height=shape[0],
        fx=fields.fx,
        fy=fields.fy,
        cx=fields.cx,
        cy=fields.cy,
        world_from_camera=(
            stated_pose(f"cameras.{name}.world_from_camera", stands)
            if stands is not None
            else np.eye(7)[3]  # until the viewpoint is known
        ),
        near=fields.near,
        far=fields.far,
        distortion=fields.distortion,
        wrist_from_camera=(
            None if hand_eye is None else stated_pose(f"cameras.{name}.frame_from_camera", hand_eye)
        ),
    )
    if hand_eye is None:
        return camera, 0.0
    if image.world_from_frame is not None:
        at, speed = stated_pose(f"{where}.world_from_frame", image.world_from_frame), 0.0
    else:
        assert image.time is not None
        at, speed = _at_time(where, factor(fields.time_unit) * image.time, world_from_frame)
    number = where[where.index("[") + 1 : -1]
    return camera.on(at, name if len(fields.images) == 1 else f"{name} {number}"), speed


def _at_time(where: str, time: float, poses: Stream) -> tuple[Array, float]:
    if not is_known(poses, np.array([time]), None)[0]:
        raise InputError(
            f"{where}.time is {time:.3f} s, when no pose was logged ({poses.times[0]:.3f} to "
            f"{poses.times[-1]:.3f} s); give it on the pose's clock, or state its world_from_frame."
        )
    around = np.array([time - _AROUND, time, time + _AROUND])
    at = poses_at(poses, np.clip(around, poses.times[0], poses.times[-1]))
    speed = float(np.linalg.norm(at[2, :3] - at[0, :3])) / (2.0 * _AROUND)
    return at[1], speed


def placed(base_from_frame: Stream, world_from_base: Array) -> Stream:
    """The poses (T, 7) of the frame in the world."""
    return Stream(
        base_from_frame.name, base_from_frame.times, composed(world_from_base, base_from_frame.values)
    )
