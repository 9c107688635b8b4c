"""Gravity compensation of a wrench sensor: the tool's load, its weight, and its identification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.poses import as_pose, rotation_matrix

STANDARD_GRAVITY = (0.0, 0.0, -9.80665)
FARTHEST_CENTER = 2.0  # m: a centre farther than this from the sensor comes from torques in N mm
LONGEST_LEVER = 30.0  # in reaches of the peg; torques that need a longer one are in N mm
_TILTED = 0.05  # lower bound of the second singular value of gravity's directions, over gravity


@dataclass(frozen=True)
class ToolLoad:
    """Mass and centre of mass of everything below the sensor.

    Attributes:
        mass: kg.
        center: (3,) the centre of mass, metres, in the frame of the wrenches, such as the peg's.
        gravity: (3,) in the world, m/s^2.
    """

    mass: float
    center: tuple[float, float, float]
    gravity: tuple[float, float, float] = STANDARD_GRAVITY

    def __post_init__(self) -> None:
        number_within("a tool's mass is {} kg", self.mass, least=0.0)
        away = float(np.linalg.norm(self.center))
        number_within("a tool's centre of mass is {} m from the sensor", away, most=FARTHEST_CENTER)

    def weight(self, world_from_sensor: Array) -> Array:
        """Wrench (..., 6) of the weight, in the sensor's frame about its origin, at poses (..., 7).

        It depends on the orientation only. Inertial forces are not compensated.

        Raises:
            InputError: a pose is not seven finite numbers with a unit quaternion.
        """
        force = self.mass * gravity_in(world_from_sensor, self.gravity)
        center = np.asarray(self.center, dtype=np.float64)
        return np.concatenate([force, np.cross(center, force)], axis=-1)


def gravity_in(world_from_sensor: Array, gravity: tuple[float, float, float] = STANDARD_GRAVITY) -> Array:
    """Gravity (..., 3) in the frames of sensors at poses (..., 7), m/s^2."""
    pose = as_pose(world_from_sensor, "a sensor's pose").numpy()
    if pose.size == 0:
        return np.empty((*pose.shape[:-1], 3))
    turn = Rotation.from_quat(pose.reshape(-1, 7)[:, [4, 5, 6, 3]])
    return np.asarray(turn.inv().apply(gravity)).reshape(*pose.shape[:-1], 3)


def tilts_enough(pulls: Array) -> bool:
    """Whether directions of gravity (K, 3), in a sensor's frame, determine its load's place.

    Those in one plane leave the place along a line undetermined.
    """
    values = np.linalg.svd(pulls - pulls.mean(axis=0), compute_uv=False) / np.sqrt(len(pulls))
    return bool(values[1] >= _TILTED * np.linalg.norm(STANDARD_GRAVITY))


def transform_wrench(wrench: Array, to_from_from: Array) -> Array:
    """Wrenches (..., 6) in another frame, about its origin, such as the peg's instead of the sensor's.

    Args:
        wrench: force and torque (..., 6).
        to_from_from: (7,) the pose from the wrench's frame to the other, `peg_from_sensor`; or (..., 7), one
            for each wrench, where the frames turn against each other, as those of a log in the base's axes.

    Raises:
        InputError: a pose is not seven finite numbers with a unit quaternion, or there are neither one nor as
            many poses as wrenches.
    """
    wrench = np.asarray(wrench, dtype=np.float64)
    pose = as_pose(to_from_from, "the pose from one wrench's frame to the other")
    if pose.ndim > 1 and pose.shape[:-1] != wrench.shape[:-1]:
        raise InputError(
            f"wrenches of shape {wrench.shape} are given poses of shape {tuple(pose.shape)}; give one pose "
            "(7,), or one for each wrench."
        )
    turn = np.swapaxes(rotation_matrix(pose).numpy(), -1, -2)
    force = (wrench[..., None, :3] @ turn)[..., 0, :]
    torque = (wrench[..., None, 3:] @ turn)[..., 0, :]
    return np.concatenate([force, torque + np.cross(pose[..., :3].numpy(), force)], axis=-1)


@dataclass(frozen=True, eq=False)
class LoadEstimate:
    """A tool's load, estimated from static readings.

    Attributes:
        load: mass and centre of mass.
        bias: (6,) the sensor's zero, N and N m.
        covariance: (10, 10) of mass (kg), centre (m) and bias (N, N m), in this order.
        noise: standard deviations of a reading's residuals, N and N m.
    """

    load: ToolLoad
    bias: Array
    covariance: Array
    noise: tuple[float, float]

    @property
    def standard_deviation(self) -> Array:
        """Standard deviations (10,) of mass, centre and bias."""
        return np.sqrt(np.diagonal(self.covariance))


def identify_load(wrench: Array, world_from_sensor: Array) -> LoadEstimate:
    """Mass, centre of mass and the sensor's bias, from readings at rest and free of contact.

    With g the gravity in the sensor's frame, force = m g + bias and torque = (m c) x g + bias are linear in
    m, m c and the biases: two least-squares problems, whose noise is estimated from their residuals. The
    centre is m c over m, its covariance to first order. Poses tilted about two axes by 30 degrees or more are
    enough; six to ten, each the mean of a second, are usual. The covariance does not include errors that
    readings share, such as the pull of a cable.

    Args:
        wrench: (K, 6) raw readings, force (N) and torque (N m) of the tool's weight on the sensor, in the
            sensor's frame about its origin.
        world_from_sensor: (K, 7) the sensor's poses, in a world whose z axis points up.

    Raises:
        InputError: fewer than four readings, numbers that are not finite, poses that are not tilted enough, a
            force with the wrong sign, or torques in N mm.
    """
    wrench = np.asarray(wrench, dtype=np.float64)
    if len(wrench) < 4:
        raise InputError(f"{len(wrench)} static readings do not determine load and bias; give four or more.")
    if not np.isfinite(wrench).all():
        raise InputError("a static reading holds a wrench that is not finite; leave it out.")
    pulls = gravity_in(world_from_sensor)
    if not tilts_enough(pulls):
        raise InputError(
            "the static readings have the same tilt; tilt the sensor about two axes by 30 degrees or more."
        )
    unit = np.tile(np.eye(3), (len(pulls), 1))
    forces = np.column_stack([pulls.reshape(-1), unit])
    # (m c) x g = -[g]x (m c)
    crossed = np.stack([np.cross(axis, pulls) for axis in np.eye(3)], axis=-1).reshape(-1, 3)
    torques = np.column_stack([crossed, unit])
    (mass, *force_bias), force_covariance, force_noise = _least_squares(forces, wrench[:, :3].reshape(-1))
    solution, torque_covariance, torque_noise = _least_squares(torques, wrench[:, 3:].reshape(-1))
    if mass <= 0:
        raise InputError(
            f"the static readings give a mass of {mass:.3g} kg: the forces have the wrong sign or no load."
        )
    center = solution[:3] / mass
    if not np.linalg.norm(center) <= FARTHEST_CENTER:
        raise InputError(
            f"the static readings put the centre of mass {np.linalg.norm(center):.0f} m from the sensor: "
            "the torques are probably in N mm; scale them by 0.001."
        )
    # From (mass, force bias) and (m c, torque bias) to mass, centre and bias.
    jacobian = np.zeros((10, 10))
    jacobian[0, 0] = 1.0
    jacobian[1:4, 0], jacobian[1:4, 4:7] = -center / mass, np.eye(3) / mass
    jacobian[4:7, 1:4], jacobian[7:, 7:] = np.eye(3), np.eye(3)
    blocks = np.zeros((10, 10))
    blocks[:4, :4], blocks[4:, 4:] = force_covariance, torque_covariance
    load = ToolLoad(float(mass), (float(center[0]), float(center[1]), float(center[2])))
    return LoadEstimate(
        load,
        np.concatenate([force_bias, solution[3:]]),
        jacobian @ blocks @ jacobian.T,
        (force_noise, torque_noise),
    )


def _least_squares(design: Array, readings: Array) -> tuple[Array, Array, float]:
    """Solution, its covariance, and the noise's standard deviation estimated from the residuals."""
    solution = np.asarray(np.linalg.lstsq(design, readings, rcond=None)[0])
    residual = readings - design @ solution
    variance = float(residual @ residual) / (len(readings) - design.shape[1])
    return solution, np.asarray(variance * np.linalg.inv(design.T @ design)), float(np.sqrt(variance))


def refuse_millimetres(wrench: Array, reach: float) -> None:
    """Refuse tared wrenches (M, 6) in contact whose torques are in N mm, unless they are fewer than three.

    The reach is the distance (m) of the peg's farthest point from their origin.
    """
    if len(wrench) < 3:
        return
    force, torque = np.linalg.norm(wrench[:, :3], axis=1), np.linalg.norm(wrench[:, 3:], axis=1)
    lever = float(np.median(torque / force))
    if lever > LONGEST_LEVER * reach:
        raise InputError(
            f"the wrenches act {lever:.3g} m from the origin of a peg that ends {reach:.3g} m from it: "
            "their torques are probably in N mm; scale them by 0.001."
        )
