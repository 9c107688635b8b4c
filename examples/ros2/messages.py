"""ROS 2 messages as arrays, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header

from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.recordings.importers.bag.images import intrinsics_of, pixels_of
from bcppl.robot.plan import Plan
from bcppl.sensors import DepthImage, View


def seconds(stamp: Time) -> float:
    """A stamp in seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def header(stamp: float, frame: str) -> Header:
    """A header of a stamp (s)."""
    whole = int(stamp // 1.0)
    return Header(stamp=Time(sec=whole, nanosec=int(1e9 * (stamp - whole))), frame_id=frame)


def pose_of(message: Pose) -> Array:
    """The pose (7,) of a message."""
    at, turn = message.position, message.orientation
    return np.array([at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z])


def pose_message(pose: Array) -> Pose:
    """The message of a pose (7,)."""
    message = Pose()
    at, turn = message.position, message.orientation
    at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z = (float(each) for each in pose)
    return message


def path_of(plan: Plan, frame: str) -> list[PoseStamped]:
    """The knots of a plan, stamped from its beginning."""
    knots = zip(plan.times - plan.times[0], plan.world_from_peg, strict=True)
    return [PoseStamped(header=header(time, frame), pose=pose_message(pose)) for time, pose in knots]


def covariance_of(belief: Belief) -> list[float]:
    """The covariance (36,) of the mean pose, rotations about the fixed axes of the frame that it is in."""
    mean = belief.mean.numpy()
    turn = np.eye(6)  # the belief's rotations are about the part's axes
    turn[3:, 3:] = Rotation.from_quat(mean[[4, 5, 6, 3]]).as_matrix()
    return [float(each) for each in (turn @ belief.covariance.numpy() @ turn.T).ravel()]


def view_of(info: Any, world_from_camera: Array) -> View:
    """The view of a camera, by its CameraInfo and the pose (7,) of its optical frame.

    Raises:
        InputError: the camera is not calibrated, or its lens is of another model than Brown's.
    """
    name = info.header.frame_id
    stated = intrinsics_of(f"the information of camera {name!r}", info, "calibrate it")
    return View(
        Camera(name, int(info.width), int(info.height), world_from_camera=world_from_camera, **stated)
    )


def depth_of(image: Any, view: View) -> DepthImage:
    """The depth of an Image, in metres, NaN where missing (REP 118: 16UC1 is in millimetres).

    Raises:
        InputError: it has no depth, or is of another size than the view.
    """
    camera = view.camera
    where = f"the image of camera {camera.name!r}"
    pixels, unit = pixels_of(where, image, (camera.height, camera.width))
    depth = (0.001 if unit == "mm" else 1.0) * pixels
    depth[~np.isfinite(depth) | (depth <= 0.0)] = np.nan
    if np.isnan(depth).all():
        raise InputError(f"{where} has no pixel with a depth; see where it looks.")
    return DepthImage(depth)
