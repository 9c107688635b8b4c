"""A pinhole camera with Brown's lens distortion, and its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.distortion import LARGEST, Optics, distorted, undistorted_rays, unfolded

if TYPE_CHECKING:
    from torch import Tensor

# Advice where a part is behind a camera.
OPTICAL = (
    "give its world_from_camera with x right, y down and z forward (OpenGL's convention, y up and z "
    "backward, is turned by half a turn about x)"
)


@dataclass(frozen=True, eq=False, repr=False)
class Camera:
    """A camera with its optical frame: x right, y down, z forward; depth is along z, metres.

    A camera on a wrist is one camera for each viewpoint: see `on`.

    Attributes:
        name: identifies the camera; views from two viewpoints are two cameras.
        width, height: the image's size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels; pixel (u, v) is centred at the
            integers, so without distortion its ray is ((u - cx) / fx, (v - cy) / fy, 1).
        world_from_camera: (7,) pose of the optical frame (the extrinsics).
        near, far: the sensor's range in metres: a depth outside it is missing, not far away.
        distortion: k1 k2 p1 p2 (k3) of Brown's model, in OpenCV's order; empty for none. Depth images are
            often rectified already, and then have none: see the driver's camera information.
        wrist_from_camera: (7,) hand-eye calibration of a wrist camera; None for a stationary camera.
        device: identifies the instrument where one has several viewpoints; "" where it is `name`.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: Array
    near: float = 0.05
    far: float = 10.0
    distortion: Sequence[float] = field(default=())
    wrist_from_camera: Array | None = None
    device: str = ""

    def __post_init__(self) -> None:
        given = () if self.distortion is None else self.distortion
        object.__setattr__(self, "distortion", tuple(float(k) for k in np.ravel(np.asarray(given))))

    def __repr__(self) -> str:
        at = ", ".join(f"{x:.3f}" for x in np.ravel(np.asarray(self.world_from_camera))[:3])
        size, lens = f"{self.width} x {self.height}", f"focal lengths {self.fx:.5g} and {self.fy:.5g} pixels"
        return f"Camera({self.name!r}, {size}, {lens}, at ({at}) m)"

    @property
    def is_distorted(self) -> bool:
        """Whether a distortion coefficient is not zero."""
        return any(k != 0.0 for k in self.distortion)

    @property
    def optics(self) -> Optics:
        """Width, height, (fx, fy, cx, cy) and distortion: all that the rays depend on."""
        intrinsics = (float(self.fx), float(self.fy), float(self.cx), float(self.cy))
        return self.width, self.height, intrinsics, tuple(self.distortion)

    def stated_pose(self) -> Tensor:
        """The checked `world_from_camera` (7,), its quaternion normalised.

        The constructor accepts any numbers, so that a recording with wrong ones can be read and reported;
        renderers check here.

        Raises:
            InputError: the pose is not valid; there are no pixels; a focal length is not positive, the
                principal point is not finite, or near is not below far.
        """
        self._check_optics()
        pose = poses.as_pose(self.world_from_camera, f"the world_from_camera of {self.name!r}")
        if pose.ndim != 1:
            raise InputError(
                f"camera {self.name!r} has poses of shape {tuple(pose.shape)}; give one pose (7,) a camera."
            )
        return pose

    def _check_optics(self) -> None:
        for size, count in (("wide", self.width), ("high", self.height)):
            whole_number(f"camera {self.name!r} is {{}} pixels {size}", count)
        for name, value in (("fx", self.fx), ("fy", self.fy)):
            what = f"camera {self.name!r} has a focal length {name} {{}} pixels (flip mirrored images)"
            number_within(what, value, above=0.0)
        for name, centre in (("cx", self.cx), ("cy", self.cy)):
            number_within(f"camera {self.name!r} has its principal point at {name} {{}} pixels", centre)
        near = number_within(f"camera {self.name!r} has a range from {{}} m", self.near, least=0.0)
        if self.far != np.inf:
            number_within(f"camera {self.name!r} has a range from {near} m to {{}} m", self.far, above=near)

    @property
    def instrument(self) -> str:
        """Identifies the instrument, whose cameras share calibration errors: the device, else the name."""
        return self.device or self.name

    def rays(self) -> Array:
        """Directions (height * width, 3) of the pixels' rays in the optical frame, z = 1: lengths are depths.

        Raises:
            InputError: as `stated_pose` for the optics, or the distortion folds the image over, so that a
                pixel has no unique ray.
        """
        self._check_optics()
        return undistorted_rays(self.optics).copy()

    def project(self, points: npt.ArrayLike) -> Array:
        """Projections (..., 2) of points (..., 3) in the optical frame (metres): pixels, u then v.

        They may lie outside the image. NaN where a point is not in front of the camera, or so far off axis
        that the distortion would fold it back into the image.
        """
        places = np.asarray(points, dtype=np.float64)
        depth = places[..., 2]
        ahead = depth > 0.0
        plane = places[..., :2] / np.where(ahead, depth, 1.0)[..., None]
        if self.is_distorted:
            ahead = ahead & unfolded(plane, tuple(self.distortion))
            plane = distorted(np.clip(plane, -LARGEST, LARGEST), tuple(self.distortion))
        pixel = plane * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy])
        return np.where(ahead[..., None], pixel, np.nan)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of a region of interest: `depth[top : top + height, left : left + width]`.

        It keeps its name: crop every image of a camera, and its background, alike.

        Raises:
            InputError: the region is not of whole pixels, is empty or extends beyond the image.
        """
        inside = 0 <= left < left + width <= self.width and 0 <= top < top + height <= self.height
        if not inside or any(n != int(n) for n in (left, top, width, height)):
            raise InputError(
                f"a region of {width}×{height} pixels from column {left}, row {top} is empty or not within "
                f"camera {self.name!r} of {self.width}×{self.height} pixels; give whole pixels in it."
            )
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def binned(self, k: int) -> Camera:
        """The camera whose pixels are blocks of k × k of this one's; see `bin_depth` for its images.

        Incomplete blocks at the right and below are dropped. It keeps its name.

        Raises:
            InputError: no block fits into the image.
        """
        _check_block(k, self.width, self.height)
        middle = 0.5 * (k - 1)
        return replace(
            self,
            width=self.width // k,
            height=self.height // k,
            fx=self.fx / k,
            fy=self.fy / k,
            cx=(self.cx - middle) / k,
            cy=(self.cy - middle) / k,
        )

    def on(self, world_from_wrist: npt.ArrayLike, name: str | None = None) -> Camera:
        """The wrist camera at one viewpoint.

        Args:
            world_from_wrist: (7,) the wrist's pose, from the arm's forward kinematics.
            name: of the camera at this viewpoint; give each its own. They stay one `device`.

        Raises:
            InputError: the camera has no `wrist_from_camera`, or a pose is not valid.
        """
        if self.wrist_from_camera is None:
            raise InputError(f"camera {self.name!r} has no wrist_from_camera; give its hand-eye calibration.")
        there = poses.compose(
            poses.as_pose(world_from_wrist, "world_from_wrist"),
            poses.as_pose(self.wrist_from_camera, f"{self.name!r}'s wrist_from_camera"),
        )
        return replace(self, name=name or self.name, world_from_camera=there.numpy(), device=self.instrument)


def bin_depth(
    depth: npt.ArrayLike, k: int, edge: float = 0.01, near: float = 0.0, far: float = np.inf
) -> Array:
    """The median depth (H // k, W // k) of blocks of k × k pixels, metres, NaN where all are missing.

    Of an even number of valid readings the two middle ones are averaged only where they differ by at most
    `edge`; otherwise the nearer is the result: a mean across a depth edge lies on no surface.

    Args:
        depth: (H, W) metres; 0, NaN and values out of range are missing.
        k: side length of a block, pixels.
        edge: smallest depth discontinuity, metres.
        near: lower end of the sensor's range, metres.
        far: upper end of the sensor's range, metres.

    Raises:
        InputError: no block fits into the image.
    """
    image = np.asarray(depth, dtype=np.float64)
    height, width = image.shape
    _check_block(k, width, height)
    rows, columns = height // k, width // k
    blocks: Array = (
        image[: rows * k, : columns * k]
        .reshape(rows, k, columns, k)
        .transpose(0, 2, 1, 3)
        .reshape(rows, columns, k * k)
    )
    valid = np.isfinite(blocks) & (blocks > 0.0) & (blocks >= near) & (blocks <= far)
    ordered = np.sort(np.where(valid, blocks, np.inf), axis=-1)
    count = valid.sum(axis=-1)
    lower = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[..., None], axis=-1)[..., 0]
    upper = np.take_along_axis(ordered, np.minimum(count // 2, k * k - 1)[..., None], axis=-1)[..., 0]
    lower, upper = np.where(count > 0, lower, np.nan), np.where(count > 0, upper, np.nan)
    return np.asarray(np.where(upper - lower <= edge, 0.5 * (lower + upper), lower))


def _check_block(k: int, width: int, height: int) -> None:
    whole_number(f"an image of {width}×{height} pixels is binned by {{}}", k, most=min(width, height))


def looking_at(eye: npt.ArrayLike, point: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """The pose (7,) `world_from_camera` of an optical frame at `eye` with its optical axis through `point`.

    Args:
        eye: (3,) position of the camera in the world, metres.
        point: (3,) in the world, metres.
        up: (3,) direction in the world that is upwards in the image.

    Raises:
        InputError: the camera would look at itself, or straight along `up`.
    """
    there = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(point, dtype=np.float64) - there
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if not np.linalg.norm(right) > 1e-9 * max(float(np.linalg.norm(forward)), 1e-9):
        raise InputError(
            f"a camera at {there.tolist()} cannot look at {np.asarray(point).tolist()} with "
            f"{np.asarray(up).tolist()} upwards; give another point, or another direction for up."
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    from scipy.spatial.transform import Rotation

    return np.concatenate([there, Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]]])
