"""Views: a camera takes a depth image."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bcppl import poses
from bcppl.arrays import Array, as_array
from bcppl.errors import InputError
from bcppl.geometry.camera import OPTICAL, Camera, looking_at
from bcppl.geometry.distortion import coefficients
from bcppl.geometry.parts import Part
from bcppl.sensors import checks
from bcppl.sensors.layout import POSE_UNITS, TEXT, Layout, number, numbers, shared
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import FAINT, Indexed, Placement, PlannedAsIs, register

MOST_DEPTH = 100.0  # m: beyond it a median depth is in millimetres
OFF_CENTRE = 0.45  # of an image's side: a lens is centred better, so the calibration is of another size
WIDEST = 0.1  # focal lengths for each width of an image: a shorter one would see 157 degrees and more
COLOUR = "#D55E00"
USUAL = Camera("camera", 160, 120, 160.0, 160.0, 79.5, 59.5, np.eye(7)[3], near=0.1, far=2.0)
DISTANCE = 0.45  # m from the part, of a camera like no other
HEIGHTS = (50.0, 70.0, 35.0)  # degrees above the horizon, in turn
GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class View:
    """Action: a depth image is taken with a camera, whose pose is the one that its owner states."""

    camera: Camera


@dataclass(frozen=True, eq=False, repr=False)
class DepthImage:
    """Observation: depth along the optical axis, (H, W) metres, NaN where missing; colour (H, W, 3)."""

    depth: Array
    rgb: npt.NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth", as_array(self.depth))

    def __repr__(self) -> str:
        depth = np.asarray(self.depth)
        known = depth[np.isfinite(depth)]
        depths = f"{known.min():.3f} to {known.max():.3f} m" if known.size else "no depth"
        return f"DepthImage({' x '.join(map(str, depth.shape))}, {depths}, {depth.size - known.size} missing)"


CAMERA = Layout(
    Camera,
    {
        "world_from_camera": numbers(POSE_UNITS),
        **{name: number("pixel", np.int64) for name in ("width", "height")},
        **{name: number("pixel") for name in ("fx", "fy", "cx", "cy")},
        **{name: number("m") for name in ("near", "far")},
        "distortion": numbers("1"),
        "wrist_from_camera": numbers(POSE_UNITS),
        "device": TEXT,
    },
    optional={"distortion": 2, "wrist_from_camera": 2, "device": 2},
)


def _stated_view(**fields: Any) -> View:
    """The view of a camera that somebody wrote down, which is refused where it sees nothing."""
    camera = Camera(**fields)
    camera.stated_pose()
    if camera.wrist_from_camera is not None:
        poses.as_pose(camera.wrist_from_camera, f"the wrist_from_camera of {camera.name!r}")
    return View(camera)


class DepthSensor(PlannedAsIs):
    """Depth images, each observed from one camera; a view that may be taken next is the view itself."""

    kind = "view"
    names = ("view", "views")
    contact = False
    action = Layout(View, {"camera": shared("cameras", CAMERA)})
    observation = Layout(
        DepthImage, {"depth": numbers("m", np.float32), "rgb": numbers("1", np.uint8)}, optional={"rgb": 1}
    )

    candidate_kind = "view"
    caption = ""
    candidate = Layout(
        View, {"name": TEXT, **CAMERA.fields}, CAMERA.optional, make=_stated_view, within="camera"
    )

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Problems of cameras, of their backgrounds and of their images."""
        cameras: dict[str, Camera] = {}
        for index, measurement in measurements:
            where, camera, image = f"measurement {index}", measurement.action.camera, measurement.observation
            wrong: list[str] = []
            if camera.name not in cameras:
                wrong += _camera(f"{where}: camera {camera.name!r}", camera, image, recording)
                wrong += _background(camera, recording)
            wrong += checks.named_alike(where, "camera", camera, cameras)
            wrong += _depth(where, image.depth, camera)
            if image.rgb is not None and image.rgb.shape != (camera.height, camera.width, 3):
                what = f"{where}: the colour image is {image.rgb.shape}"
                wrong.append(f"{what}, its camera {_frame(camera)} pixels.")
            yield from ((index, problem) for problem in wrong)

    def notes(self, measurements: Sequence[Measurement], recording: Recording) -> Iterator[str]:
        """Remarks on principal points at an image's edge, and on backgrounds of no camera."""
        cameras = {m.action.camera.name: m.action.camera for m in measurements}
        for camera in cameras.values():
            yield from _off_centre(camera)
        for name in recording.background:
            if name not in cameras:
                yield (
                    f"the background of {name!r} is not used: no view is of a camera of that name (there are "
                    f"{', '.join(map(repr, cameras))})."
                )

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """Each camera's size and range."""
        cameras = {m.action.camera.name: m.action.camera for m in measurements}
        rows = []
        for name, camera in cameras.items():
            size = f"{_frame(camera)} pixels, {camera.near:g} to {camera.far:g} m"
            known = "known" if name in recording.background else "unknown"
            rows.append((f"camera {name}", f"{size}, background {known}"))
        return rows

    # ---- candidates: views

    def name_of(self, candidate_or_action: View) -> str:
        """The camera's name."""
        return candidate_or_action.camera.name

    def renamed(self, candidate: View, name: str) -> View:
        """The view under another name; it stays one of the same instrument, whose error it shares."""
        camera = candidate.camera
        return View(replace(camera, name=name, device=camera.device or camera.name))

    def placement(self, candidate: View) -> Placement:
        """The camera's pose."""
        return Placement(np.asarray(candidate.camera.world_from_camera), candidate.camera.wrist_from_camera)

    def blank(self, candidate: View) -> DepthImage:
        """An image without a depth."""
        return DepthImage(np.full((candidate.camera.height, candidate.camera.width), np.nan))

    def around(self, mean: Array, part: Part, like: View | None, count: int, seed: int) -> Iterator[View]:
        """Views of the part from all around, in turn from three heights, as far off as `like` is."""
        import torch

        whole = poses.transform(torch.as_tensor(mean), torch.from_numpy(part.vertices)).numpy()
        middle = 0.5 * (whole.min(axis=0) + whole.max(axis=0))
        camera, distance = USUAL, DISTANCE
        if like is not None:
            camera = replace(like.camera, device=like.camera.instrument)
            distance = float(np.linalg.norm(np.asarray(camera.world_from_camera)[:3] - middle))
        turn = float(np.random.default_rng([seed, 3]).uniform(0.0, 2.0 * math.pi))
        for k in range(count):
            height, heading = math.radians(HEIGHTS[k % len(HEIGHTS)]), turn + k * GOLDEN
            flat = math.cos(height)
            eye = middle + distance * np.array(
                [flat * math.cos(heading), flat * math.sin(heading), math.sin(height)]
            )
            degrees = f"{round(math.degrees(heading)) % 360}°, {HEIGHTS[k % len(HEIGHTS)]:g}° up"
            pose = looking_at(eye, middle)
            yield View(replace(camera, name=f"view #: from {degrees}", world_from_camera=pose))

    def draw(
        self, axes: Any, candidate: View, mean: Array, peg: Part | None, *, faint: bool = False
    ) -> Array:
        """Draw a line from the camera to the part's origin at the mean."""
        line = 1000.0 * np.stack([np.asarray(candidate.camera.world_from_camera)[:3], mean[:3]])
        chosen = {"color": COLOUR, "linewidth": 2.6, "zorder": 6, "label": "looking"}
        axes.plot(*line.T, **(FAINT if faint else chosen))
        return line


def _size(image: Array) -> str:
    return f"{image.shape[1]}×{image.shape[0]}" if image.ndim == 2 else f"of shape {image.shape}"


def _frame(camera: Camera) -> str:
    return f"{camera.width}×{camera.height}"


def _background(camera: Camera, recording: Recording) -> Iterator[str]:
    depth = recording.background.get(camera.name)
    where = f"the background of camera {camera.name!r}"
    if depth is None:
        return
    if not isinstance(depth, np.ndarray):
        yield f"{where} is of type {type(depth).__name__}; give a NumPy array, in metres."
    elif depth.shape != (camera.height, camera.width):
        yield f"{where} is {_size(depth)}, the camera {_frame(camera)} pixels; give one of the camera's size."
    else:
        yield from _numbers(where, depth[np.isfinite(depth) & (depth != 0)])


def _numbers(where: str, read: Array) -> Iterator[str]:
    if (read < 0).any():
        yield f"{where}: {(read < 0).sum()} depths are negative; mark missing ones by NaN."
    elif read.size and (middle := float(np.median(read))) > MOST_DEPTH:
        yield f"{where}: the median depth is {middle:.0f}, probably millimetres; scale it by 0.001 to metres."


def _depth(where: str, depth: Array, camera: Camera) -> Iterator[str]:
    if not isinstance(depth, np.ndarray):
        yield f"{where}: the depth image is of type {type(depth).__name__}; give a NumPy array, in metres."
        return
    if depth.shape != (camera.height, camera.width):
        yield (
            f"{where}: the depth image is {_size(depth)}, camera {camera.name!r} {_frame(camera)} pixels; "
            "give the camera that took it."
        )
        return
    read = depth[np.isfinite(depth) & (depth != 0)]
    if read.size == 0:
        yield f"{where}: the depth image is missing in every pixel; leave the view out."
    elif wrong := list(_numbers(where, read)):
        yield from wrong
    elif not ((read >= camera.near) & (read <= camera.far)).any():
        yield (
            f"{where}: no depth lies within the range of camera {camera.name!r}, {camera.near:.4g} to "
            f"{camera.far:.4g} m (median {np.median(read):.4g} m); check the units and the range."
        )


def _camera(what: str, camera: Camera, image: DepthImage, recording: Recording) -> Iterator[str]:
    if not all(isinstance(side, int | np.integer) for side in (camera.width, camera.height)):
        yield f"{what} is {camera.width} by {camera.height} pixels; give whole numbers."
    elif camera.width < 1 or camera.height < 1 or not (camera.fx > 0 and camera.fy > 0):
        yield f"{what} has no pixels or no focal length; give its width, height, fx and fy in pixels."
    elif not np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all():
        yield f"{what} has intrinsics that are not finite; give fx, fy, cx and cy in pixels."
    elif min(camera.fx / camera.width, camera.fy / camera.height) < WIDEST:
        yield (
            f"{what} has focal lengths of {camera.fx:.4g} and {camera.fy:.4g} pixels for an image of "
            f"{camera.width} x {camera.height}, a view of nearly half the world; give them in pixels, not in "
            "millimetres."
        )
    elif camera.distortion and image.depth.shape == (camera.height, camera.width):
        # The rays of an image that is not there could take terabytes.
        try:
            coefficients(tuple(camera.distortion))
            camera.rays()
        except InputError as error:
            yield f"{what}: {error}"
        except (ValueError, ArithmeticError) as error:  # numpy's, of numbers that are all but infinite
            lens = " ".join(f"{k:g}" for k in camera.distortion)
            yield f"{what} has rays that cannot be computed ({error}); correct its distortion, {lens}."
    if camera.wrist_from_camera is not None:
        yield from checks.pose(f"{what}'s wrist_from_camera", camera.wrist_from_camera)
    if not 0 <= camera.near < camera.far:
        yield f"{what} sees from {camera.near:.4g} m to {camera.far:.4g} m; give near below far, in metres."
    wrong = list(checks.pose(f"{what}'s world_from_camera", camera.world_from_camera))
    yield from wrong
    guessed = not list(checks.pose("the guess", recording.guess.world_from_part))
    if not wrong and guessed and not list(checks.part(recording.part, closed=False)):
        yield from _stands_off(what, camera, recording)


def _off_centre(camera: Camera) -> Iterator[str]:
    size, centre = np.array([camera.width, camera.height]), np.array([camera.cx, camera.cy])
    if (np.abs(centre - 0.5 * (size - 1)) > OFF_CENTRE * size).any():
        around = "×".join(f"{side:.0f}" for side in np.maximum(2 * centre + 1, 0))
        yield (
            f"camera {camera.name!r} has its principal point at ({camera.cx:g}, {camera.cy:g}), the middle "
            f"of an image of {around} pixels, but its images are {_frame(camera)}: unless they are cropped, "
            "scale fx, fy, cx and cy with the image."
        )


def _stands_off(what: str, camera: Camera, recording: Recording) -> Iterator[str]:
    """Problems of the camera's pose relative to the part at its guess: inside it, out of range, averted."""
    guess = np.asarray(recording.guess.world_from_part, dtype=float)
    pose = np.asarray(camera.world_from_camera, dtype=float)
    eye = _turned_back(guess[3:], pose[:3] - guess[:3])
    low, high = recording.part.vertices.min(axis=0), recording.part.vertices.max(axis=0)
    radius, middle = np.linalg.norm(high - low) / 2, (low + high) / 2
    away = np.linalg.norm(eye - middle)
    to_box = np.linalg.norm(np.maximum(0.0, np.maximum(low - eye, eye - high)))
    # A long part fills a wide sphere: a camera beside it is too near only if it is near its box.
    if away <= radius and to_box < max(camera.near, 1e-3):
        yield (
            f"{what} stands {1e3 * away:.0f} mm from the middle of the part at its guess, inside it (radius "
            f"{1e3 * radius:.0f} mm): probably wrong units; give its world_from_camera in metres."
        )
    elif away - radius - np.linalg.norm(recording.guess.translation) > camera.far:
        yield (
            f"{what} stands {away:.4g} m from the part at its guess but sees only to {camera.far:.4g} m: "
            "probably wrong units; give its world_from_camera in metres."
        )
    else:
        ahead = float(_turned_back(pose[3:], guess[:3] - pose[:3])[2])
        # However the part is turned about its origin there.
        reach = np.linalg.norm(recording.part.vertices, axis=1).max()
        if ahead + reach + np.linalg.norm(recording.guess.translation) <= 0.0:
            yield (
                f"{what} looks away from the part, which at its guess is {-ahead:.4g} m behind it; "
                f"{OPTICAL}, or leave its views out."
            )


def _turned_back(quaternion: Array, vector: Array) -> Array:
    """A vector (3,) rotated by the inverse of a quaternion; without torch: a recording is checked at once."""
    w, axis = quaternion[0], -quaternion[1:]
    turned = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + w * turned + np.cross(axis, turned))


register(DepthSensor())
