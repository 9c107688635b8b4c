"""Depth images of a bench's cameras, each with the pose of its camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields, ImageFields
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.depth_images import read_depth
from bcppl.recordings.importers.bench.pose_columns import composed, stated_pose
from bcppl.recordings.importers.bench.sources import Log
from bcppl.recordings.streams import Stream, is_known, poses_at
from bcppl.sensors import DepthImage, Measurement, View

SLOW = 0.005  # m/s: an image is better taken at rest
_AROUND = 0.01  # s to either side of an image, over which the arm's speed is measured


def read_views(
    name: str, fields: CameraFields, log: Log, world_from_frame: Stream | None, report: list[str]
) -> tuple[list[Measurement], dict[str, Array]]:
    """The views of one camera, and its background by name.

    Args:
        name: of the camera.
        fields: its intrinsics, images and pose.
        log: that the images are in.
        world_from_frame: the poses (T, 7) of the robot's frame, on their clock; None if none are needed.
        report: to which a line is added.

    Raises:
        InputError: an image cannot be read, is of another size than others, or was taken when no pose was.
    """
    fields = log.intrinsics(name, fields)
    shots, notes = log.shots(name, fields)
    if fields.every is not None and fields.needs_motion and world_from_frame is not None:
        when = factor(fields.time_unit) * np.array([shot.image.time for shot in shots])
        known = is_known(world_from_frame, when, None)
        if not known.all():
            notes.append(f"{int((~known).sum())} more were taken when no pose was logged, and are left out")
        shots = [shot for shot, there in zip(shots, known, strict=True) if there]
        if not shots:
            raise InputError(f"cameras.{name} has no image at a time when a pose was logged; see its clock.")
    views: list[Measurement] = []
    shape: tuple[int, ...] | None = None
    missing, fastest = 0.0, 0.0
    count = len(shots)
    shots.reverse()
    for k in range(count):
        shot = shots.pop()  # each is released once it is read
        depth = shot.read()
        if shape is not None and depth.shape != shape:
            raise InputError(
                f"cameras.{name}: image {shot.label} has {depth.shape[1]} x {depth.shape[0]} pixels, those "
                f"before {shape[1]} x {shape[0]}; make another camera of it, with its own intrinsics."
            )
        shape, missing = depth.shape, missing + float(np.isnan(depth).mean()) / count
        place = _Place(name, f"cameras.{name}.images[{k}]", name if count == 1 else f"{name} {k}")
        camera, speed = _camera(place, fields, shot.image, depth.shape, world_from_frame)
        fastest = max(fastest, speed)
        views.append(Measurement(View(camera), DepthImage(depth)))
    moving = f"; the arm moved at up to {1000 * fastest:.0f} mm/s" if fastest > SLOW else ""
    report.append(
        f"camera {name}: {len(views)} image{'' if len(views) == 1 else 's'}, {100 * missing:.0f} % of the "
        f"pixels missing{moving}{''.join(f'; {each}' for each in notes)}"
    )
    background = {}
    if fields.background is not None:
        seen = read_depth(log.folder / fields.background, fields)
        background = {view.action.camera.name: seen for view in views}
    return views, background


@dataclass(frozen=True)
class _Place:
    """The names of an image's camera and of its viewpoint, and where the configuration states it."""

    camera: str
    where: str
    viewpoint: str


def _camera(
    place: _Place,
    fields: CameraFields,
    image: ImageFields,
    shape: tuple[int, ...],
    world_from_frame: Stream | None,
) -> tuple[Camera, float]:
    """The camera of one image, and the arm's speed (m/s) when it was taken."""
    stands = fields.world_from_camera
    hand_eye, name = fields.frame_from_camera, place.camera
    assert fields.fx is not None and fields.fy is not None
    assert fields.cx is not None and fields.cy is not None
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
        at, speed = stated_pose(f"{place.where}.world_from_frame", image.world_from_frame), 0.0
    else:
        assert image.time is not None and world_from_frame is not None
        at, speed = _at_time(place.where, factor(fields.time_unit) * image.time, world_from_frame)
    return camera.on(at, place.viewpoint), speed


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
