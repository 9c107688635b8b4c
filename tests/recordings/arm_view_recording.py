"""The shipped recording `arm_view`, made again from the folder of roboreg's five frames of an xArm7.

Run as `python -m tests.recordings.arm_view_recording FOLDER arm_view.h5`; `models/recordings/README.md`
states where they are from and what is changed.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from bcppl import poses
from bcppl.arrays import Array
from bcppl.geometry.camera import Camera, bin_depth
from bcppl.geometry.parts import Guess, Part
from bcppl.models.arm_in_view import background_of
from bcppl.recordings import DepthImage, Measurement, Recording, View, save
from bcppl.robot.kinematics import Robot

SHOWN, FRAMES, BINS = 2, 5, 4
GRID = 0.012  # m: vertices of the links in one cell are one
NEAR, FAR, MILLIMETRE = 0.3, 10.0, 0.001
ROOM = 0.3  # m about the arm that the image shows
OPTICAL_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
OFF = (0.034, -0.015, 0.022, 0.04, -0.05, 0.045)  # m and rad: the guess, from the reference
SOURCE = (
    "lbr-stack/roboreg (xArm7 and RealSense D435, frame 2), Apache-2.0; meshes xArm-Developer/xarm_ros, "
    "BSD-3-Clause; the 'truth' is another method's estimate of the camera's pose"
)


def reference(folder: Path) -> Array:
    """The pose (7,) of the arm's base in the camera's frame, by another method, from many frames."""
    body = np.load(folder / "HT_base_cam.npy").astype(np.float64)
    left, _, right = np.linalg.svd(body[:3, :3] @ OPTICAL_FROM_BODY.T)
    camera = poses.from_rotation_matrix(torch.from_numpy(body[:3, 3]), torch.from_numpy(left @ right))
    return poses.inverse(camera).numpy()


def coarse(part: Part, size: float) -> Part:
    """The part with the vertices in each cell of a grid merged at their mean."""
    _, cell = np.unique(np.round(part.vertices / size).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    sums = np.zeros((cell.max() + 1, 3))
    np.add.at(sums, cell, part.vertices)
    faces = cell[part.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Part("xarm7", sums / np.bincount(cell)[:, None], faces[np.sort(first)].astype(np.int64))


def cropped(camera: Camera, part: Part, pose: Array) -> tuple[Camera, slice, slice]:
    """The camera of the pixels about the part, and which rows and columns these are."""
    corners = part.vertices[:, None] + ROOM * np.array([[-1.0, -1, -1], [1, 1, 1]])
    seen = poses.transform(torch.from_numpy(pose), torch.from_numpy(corners.reshape(-1, 3))).numpy()
    u = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
    v = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
    left, right = max(0, math.floor(u.min())), min(camera.width, math.ceil(u.max()))
    top, bottom = max(0, math.floor(v.min())), min(camera.height, math.ceil(v.max()))
    small = replace(camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top)
    return small, slice(top, bottom), slice(left, right)


def recording(folder: Path) -> Recording:
    """The arm at rest in one frame, its base sought in the camera's frame."""
    still = poses.identity().numpy()
    whole = Camera(
        "realsense", 1280, 720, 908.30206, 908.29272, 642.96216, 372.73154, still, near=NEAR, far=FAR
    )
    images: list[npt.NDArray[np.float64]] = []
    for k in range(FRAMES):
        counts = np.asarray(Image.open(folder / f"depth_{k}.png"))
        images.append(bin_depth(MILLIMETRE * counts.astype(np.float64), BINS, near=NEAR, far=FAR))
    robot = Robot(folder / "xarm7_plain.urdf")
    part = coarse(robot.as_part(np.load(folder / f"joint_state_{SHOWN}.npy")), GRID)
    truth = reference(folder)
    camera, rows, columns = cropped(whole.binned(BINS), part, truth)
    depth, behind = (
        np.round(image[rows, columns], 3) for image in (images[SHOWN], background_of(images, SHOWN))
    )
    off = torch.tensor(OFF, dtype=torch.float64)
    guess = Guess(
        poses.retract(torch.from_numpy(truth), off).numpy(), np.full(3, 0.05), angle=math.radians(8.0)
    )
    view = Measurement(View(camera), DepthImage(depth))
    return Recording(
        part,
        guess,
        [view],
        truth=truth,
        background={camera.name: behind},
        model="part_in_view",
        source=SOURCE,
    )


if __name__ == "__main__":
    save(recording(Path(sys.argv[1])), sys.argv[2])
