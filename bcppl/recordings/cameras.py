"""A camera as a group of the native recording file (`bcppl.recordings.file`)."""

from __future__ import annotations

import h5py
import numpy as np

from bcppl.geometry.camera import Camera
from bcppl.recordings.datasets import POSE_UNITS, array, number, put

INTRINSICS = {"width": "pixel", "height": "pixel", "fx": "pixel", "fy": "pixel", "cx": "pixel", "cy": "pixel"}
RANGE = {"near": "m", "far": "m"}


def camera_version(camera: Camera) -> int:
    """The lowest schema version that holds a camera: 1 without distortion, wrist and device, else 2."""
    return 2 if camera.distortion or camera.wrist_from_camera is not None or camera.device else 1


def write_camera(group: h5py.Group, camera: Camera) -> None:
    """Write a camera; what schema version 1 did not know, only where there is any."""
    for name, units in {**INTRINSICS, **RANGE}.items():
        whole = name in ("width", "height")
        put(group, name, getattr(camera, name), units, np.int64 if whole else np.float64)
    put(group, "world_from_camera", camera.world_from_camera, POSE_UNITS)
    if camera.distortion:
        put(group, "distortion", camera.distortion, "1")
    if camera.wrist_from_camera is not None:
        put(group, "wrist_from_camera", camera.wrist_from_camera, POSE_UNITS)
    if camera.device:
        group.attrs["device"] = camera.device


def read_camera(name: str, group: h5py.Group) -> Camera:
    """Read the camera of a name, from a file of either schema version."""
    return Camera(
        name=name,
        width=int(group["width"][()]),
        height=int(group["height"][()]),
        fx=number(group, "fx"),
        fy=number(group, "fy"),
        cx=number(group, "cx"),
        cy=number(group, "cy"),
        world_from_camera=array(group, "world_from_camera"),
        near=number(group, "near"),
        far=number(group, "far"),
        distortion=array(group, "distortion").tolist() if "distortion" in group else (),
        wrist_from_camera=array(group, "wrist_from_camera") if "wrist_from_camera" in group else None,
        device=str(group.attrs.get("device", "")),
    )
