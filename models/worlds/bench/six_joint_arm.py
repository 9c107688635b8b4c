"""An arm of six joints by its Denavit-Hartenberg parameters: forward and inverse kinematics, and compliance.

Its nominal parameters are those of a common arm with 0.85 m of reach. Frames: the base's is the world's, the
grip's is that of a nominally grasped peg, its origin at the wrench sensor and its z axis away from the tip.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.errors import InputError

# (6, 4) rows of a joint: link length a (m), twist alpha (rad), offset d (m), zero of the angle (rad).
NOMINAL: Array = np.array(
    [
        [0.0, 0.5 * math.pi, 0.089159, 0.0],
        [-0.425, 0.0, 0.0, 0.0],
        [-0.39225, 0.0, 0.0, 0.0],
        [0.0, 0.5 * math.pi, 0.10915, 0.0],
        [0.0, -0.5 * math.pi, 0.09465, 0.0],
        [0.0, 0.0, 0.0823, 0.0],
    ]
)
GRIPPER = 0.15  # m from the flange to the grip
_ELBOW_UP = np.array([0.0, -1.3, 1.6, -1.9, -0.5 * math.pi, 0.0])  # rad, first guess of the inverse
_STEPS, _CLOSE = 60, 1e-11  # of Newton's method; m and rad
_FARTHEST = 0.5  # rad, largest change of a joint in a step


def matrices(pose: Array) -> Array:
    """Transformations (..., 4, 4) of poses (..., 7)."""
    pose = np.asarray(pose, dtype=np.float64)
    flat = pose.reshape(-1, 7)
    made = np.tile(np.eye(4), (len(flat), 1, 1))
    made[:, :3, :3] = Rotation.from_quat(flat[:, [4, 5, 6, 3]]).as_matrix()
    made[:, :3, 3] = flat[:, :3]
    return made.reshape(*pose.shape[:-1], 4, 4)


def pose_of(matrix: Array) -> Array:
    """Poses (..., 7) of transformations (..., 4, 4)."""
    flat = np.asarray(matrix).reshape(-1, 4, 4)
    quaternion = Rotation.from_matrix(flat[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([flat[:, :3, 3], quaternion], axis=1).reshape(*np.shape(matrix)[:-2], 7)


def displaced(matrix: Array, twist: Array) -> Array:
    """Transformations (T, 4, 4) moved by twists (T, 6): m along and rad about their own axes."""
    moved = matrix.copy()
    moved[:, :3, 3] += np.einsum("tij,tj->ti", matrix[:, :3, :3], twist[:, :3])
    moved[:, :3, :3] = matrix[:, :3, :3] @ Rotation.from_rotvec(twist[:, 3:]).as_matrix()
    return moved


class SixJointArm:
    """An arm with parameters (6, 4), rows as in `NOMINAL`, in metres and radians."""

    def __init__(self, parameters: Array) -> None:
        self.parameters = np.asarray(parameters, dtype=np.float64)

    def forward(self, joints: Array) -> Array:
        """The grip's poses `world_from_grip` as (T, 4, 4), at joint angles (T, 6) in radians."""
        return self._frames(joints)[-1]

    def inverse(self, world_from_grip: Array) -> Array:
        """Joint angles (T, 6) at which the grip is at poses (T, 4, 4), always with the elbow up.

        Newton's method from the same guess, so that the angles are continuous along a path.

        Raises:
            InputError: a pose is out of reach.
        """
        goal = np.asarray(world_from_grip, dtype=np.float64)
        joints = np.tile(_ELBOW_UP, (len(goal), 1))
        # The base faces the goal: otherwise the first steps would be too long.
        joints[:, 0] += np.arctan2(goal[:, 1, 3], goal[:, 0, 3]) + math.pi
        for _ in range(_STEPS):
            jacobian, reached = self.jacobian(joints)
            turned = np.swapaxes(reached[:, :3, :3], 1, 2)
            shift = np.einsum("tij,tj->ti", turned, goal[:, :3, 3] - reached[:, :3, 3])
            turn = Rotation.from_matrix(turned @ goal[:, :3, :3]).as_rotvec()
            error = np.concatenate([shift, turn], axis=1)
            if np.abs(error).max() < _CLOSE:
                return joints
            damped = jacobian @ np.swapaxes(jacobian, 1, 2) + 1e-12 * np.eye(6)
            step = np.einsum("tji,tj->ti", jacobian, np.linalg.solve(damped, error[..., None])[..., 0])
            largest = np.abs(step).max(axis=1, keepdims=True)
            joints = joints + step * np.minimum(1.0, _FARTHEST / np.maximum(largest, 1e-12))
        raise InputError(
            "a command of the bench is out of the arm's reach; plan within 0.8 m of the world's origin."
        )

    def jacobian(self, joints: Array) -> tuple[Array, Array]:
        """The grip's Jacobians (T, 6, 6), m and rad in its own axes per rad of a joint, and its poses."""
        frames = self._frames(joints)
        grip = frames[-1]
        turned = np.swapaxes(grip[:, :3, :3], 1, 2)
        columns = []
        for k in range(6):
            axis, origin = frames[k][:, :3, 2], frames[k][:, :3, 3]
            linear = np.cross(axis, grip[:, :3, 3] - origin)
            columns.append(
                np.concatenate(
                    [np.einsum("tij,tj->ti", turned, linear), np.einsum("tij,tj->ti", turned, axis)], axis=1
                )
            )
        return np.stack(columns, axis=2), grip

    def _frames(self, joints: Array) -> list[Array]:
        """The frames (T, 4, 4) before each joint, and the grip's."""
        frame = np.tile(np.eye(4), (len(joints), 1, 1))
        frames = [frame]
        for k, (length, twist, offset, zero) in enumerate(self.parameters):
            angle = joints[:, k] + zero
            c, s, ca, sa = np.cos(angle), np.sin(angle), math.cos(twist), math.sin(twist)
            link = np.zeros((len(joints), 4, 4))
            link[:, 0] = np.stack([c, -s * ca, s * sa, length * c], axis=1)
            link[:, 1] = np.stack([s, c * ca, -c * sa, length * s], axis=1)
            link[:, 2, 1:] = sa, ca, offset
            link[:, 3, 3] = 1.0
            frame = frame @ link
            frames.append(frame)
        # The flange's z axis points at the tip, the grip's away from it.
        frames[-1] = frame @ np.array(
            [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, GRIPPER], [0.0, 0.0, 0.0, 1.0]]
        )
        return frames


def error_scale(world_from_grip: Array, spread: Array) -> float:
    """The rms translation (m) at a pose (7,) of an arm whose parameters err by a spread (6, 4)."""
    joints = nominal_arm().inverse(matrices(world_from_grip)[None])
    step, squares = 1e-6, 0.0
    there = nominal_arm().forward(joints)[0, :3, 3]
    for index in np.ndindex(*spread.shape):
        changed = NOMINAL.copy()
        changed[index] += step
        moved = SixJointArm(changed).forward(joints)[0, :3, 3]
        squares += float(np.sum(((moved - there) / step * spread[index]) ** 2))
    return math.sqrt(squares)


@functools.cache
def nominal_arm() -> SixJointArm:
    """The arm that the robot's controller takes itself for."""
    return SixJointArm(NOMINAL)


def chain_compliance(jacobian: Array, joints: Array, gripper: Array) -> Array:
    """Compliances (T, 6, 6) of elastic joints and a gripper in series, at the grip and in its axes.

    A wrench w on the grip turns joint k by joints[k] (J^T w)[k]; so its displacement is J diag(joints) J^T w
    and, of the gripper's, gripper * w. They are m/N, rad/N and rad/(N m).

    Args:
        jacobian: (T, 6, 6) of the grip.
        joints: (6,) compliances of the joints, rad/(N m).
        gripper: (6,) compliances along and about the grip's axes, m/N and rad/(N m).
    """
    return np.asarray((jacobian * joints) @ np.swapaxes(jacobian, 1, 2) + np.diag(gripper))


def tip_compliance(compliance: Array, tip: float) -> float:
    """The mean over directions of the compliance (m/N) of a tip at (0, 0, tip) m in the grip's frame."""
    at_tip = np.zeros((3, 6))
    at_tip[:, :3] = np.eye(3)
    at_tip[0, 4], at_tip[1, 3] = tip, -tip
    return float(np.trace(at_tip @ compliance @ at_tip.T)) / 3.0
