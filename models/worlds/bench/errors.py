"""Errors of a real bench, all of them off by default, and how large each is in one scene.

Each is drawn from a stream of random numbers of its own: that one is on changes no draw of another, nor of
the rest of a scene. A scene with all errors off is equal to the bit to one without this module.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.models.worlds.bench import six_joint_arm

_STREAM = 20  # of random numbers, with a number for each error; those before are of `bench`
_GRASP, _SLIP, _SLIDE, _KINEMATIC, _BENDING, _DELAY, _GAIN, _ZERO, _DIMENSIONS = range(9)
# Proportions of the arm's errors: of (a, alpha, d, zero) in m and rad. `kinematic` sets their size.
_PARAMETER_SPREAD: Array = np.tile([1e-4, 3e-4, 1e-4, 3e-4], (6, 1))
# Of the joints' compliance, rad/(N m), and the gripper's, m/N and rad/(N m): each gives a tip about 10 um/N.
_JOINTS, _GRIPPER = np.full(6, 2.6e-5), np.array([5e-6] * 3 + [1.2e-3, 1.2e-3, 1e-3])
COMPLIANCE_RATIO = 0.3  # standard deviation in natural log of each joint's and each axis' share
REFERENCE: Array = np.array([0.5, 0.0, 0.23, 1.0, 0.0, 0.0, 0.0])  # (7,) world_from_grip over the bench
TIP = -0.08  # m, of a nominal peg's tip along the grip's z


@dataclass(frozen=True)
class BenchErrors:
    """Sizes of the errors: standard deviations where not stated; 0 is off.

    Attributes:
        grasp_shift, grasp_turn, grasp_yaw: of the peg in the hand, m along each axis, rad about x and y of
            the grip, and rad about the peg's axis.
        slip: how far the peg slips in the hand at one touch, m.
        slide: how far the part slides on the table at one touch, m.
        kinematic: rms error of the grip's position over scenes, m: link lengths and joint offsets are wrong.
        compliance: median over scenes of what the arm and the gripper yield at the peg's tip, m/N.
        compliance_spread: of its natural logarithm.
        delay: limits of how late the wrench is, s; uniform.
        gain: of the factor on the wrench.
        zero: the largest drift of the sensor's zero over the workspace, N; uniform from 0.
        dimension: of the peg's radius and of its length, m. What a contact sees of a part that is off is the
            same, so the peg stands for both.
    """

    grasp_shift: float = 0.0
    grasp_turn: float = 0.0
    grasp_yaw: float = 0.0
    slip: float = 0.0
    slide: float = 0.0
    kinematic: float = 0.0
    compliance: float = 0.0
    compliance_spread: float = 0.4
    delay: tuple[float, float] = (0.0, 0.0)
    gain: float = 0.0
    zero: float = 0.0
    dimension: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            for number in value if isinstance(value, tuple) else (value,):
                number_within(f"the bench's error {field.name} is {{}}", number, least=0.0)
        if self.delay[0] > self.delay[1]:
            raise InputError(f"the wrench is late by {self.delay} s; give the smaller limit first.")

    @classmethod
    def real(cls, scale: float = 1.0) -> BenchErrors:
        """All errors together, as on a real bench, times a scale."""
        return cls._scaled({name: value for fault in FAULTS.values() for name, value in fault.items()}, scale)

    @classmethod
    def only(cls, name: str, scale: float = 1.0) -> BenchErrors:
        """One of the errors in `FAULTS`, "none" or "real", at the size of a real bench times a scale.

        Raises:
            InputError: there is no error of that name.
        """
        if name == "none":
            return cls()
        if name == "real":
            return cls.real(scale)
        if name not in FAULTS:
            raise InputError(
                f"the bench has no error {name!r}; its errors are none, real, {', '.join(FAULTS)}."
            )
        return cls._scaled(FAULTS[name], scale)

    @classmethod
    def _scaled(cls, sizes: Mapping[str, Any], scale: float) -> BenchErrors:
        scaled: dict[str, Any] = {
            name: tuple(scale * x for x in size) if isinstance(size, tuple) else scale * size
            for name, size in sizes.items()
        }
        return cls(**scaled)


FAULTS: Mapping[str, Mapping[str, Any]] = {
    "grasp": {
        "grasp_shift": 0.0005,
        "grasp_turn": math.radians(0.5),
        "grasp_yaw": math.radians(1.0),
    },
    "slip": {"slip": 0.0003},
    "slide": {"slide": 0.0003},
    "kinematic": {"kinematic": 0.0003},
    "bending": {"compliance": 20e-6},
    "delay": {"delay": (0.005, 0.040)},
    "gain": {"gain": 0.05},
    "zero": {"zero": 1.0},
    "dimensions": {"dimension": 0.00005},
}


@dataclass(frozen=True, eq=False)
class DrawnErrors:
    """The errors of one scene.

    Attributes:
        grasp: (6,) tangent of the true `grip_from_peg`, m and rad.
        slip, slide: m; as stated.
        slip_at, slide_at: in [0, 1): which of a probe's guarded touches they happen at.
        slip_side: (3,) standard normal: what the slip's direction has beside the force's.
        arm: (6, 4) errors of the arm's parameters, as `six_joint_arm.NOMINAL`.
        joints: (6,) compliances of the joints, rad/(N m); zero for a stiff arm.
        gripper: (6,) of the gripper along and about its axes, m/N and rad/(N m).
        delay: of the wrench, s.
        gain: factor on the wrench.
        zero: (3,) N, the drift of the sensor's zero far along `zero_along`, in the world's axes.
        zero_along: (3,) unit vector.
        peg_growth: (2,) by which the peg's radius and length exceed the nominal ones, m.
    """

    grasp: Array
    slip: float
    slide: float
    slip_at: float
    slide_at: float
    slip_side: Array
    arm: Array
    joints: Array
    gripper: Array
    delay: float
    gain: float
    zero: Array
    zero_along: Array
    peg_growth: Array

    @property
    def arm_is_exact(self) -> bool:
        """Whether the arm's parameters are the nominal ones."""
        return not self.arm.any()

    @property
    def arm_is_stiff(self) -> bool:
        """Whether nothing yields beyond the joints' encoders."""
        return not (self.joints.any() or self.gripper.any())

    @property
    def arm_is_right(self) -> bool:
        """Whether encoders state the grip's true pose."""
        return self.arm_is_exact and self.arm_is_stiff


def drawn_errors(
    seed: int, errors: BenchErrors, clearance: float = math.inf, *, is_round: bool = False
) -> DrawnErrors:
    """The errors of a scene, by its seed.

    Args:
        seed: same seed, same errors, but for their sizes.
        errors: their sizes.
        clearance: of peg and hole, m, diametral: a peg that leaves less than half of it is not drawn, for a
            peg that does not fit would not be on the bench.
        is_round: whether the peg is round about its axis: then it has no turn about it.
    """
    yaw = 0.0 if is_round else errors.grasp_yaw
    grasp = _stream(seed, _GRASP).normal(size=6)
    slip, slide = _stream(seed, _SLIP), _stream(seed, _SLIDE)
    zero, delay = _stream(seed, _ZERO), _stream(seed, _DELAY)
    slip_at, slip_side = float(slip.uniform()), slip.normal(size=3)
    arm, joints, gripper = np.zeros((6, 4)), np.zeros(6), np.zeros(6)
    if errors.kinematic > 0.0:
        arm = parameter_spread(errors.kinematic) * _stream(seed, _KINEMATIC).normal(size=(6, 4))
    if errors.compliance > 0.0:
        joints, gripper = _compliances(seed, errors)
    zero_share, zero_force, zero_along = zero.uniform(), zero.normal(size=3), zero.normal(size=3)
    return DrawnErrors(
        grasp=grasp * np.array([*[errors.grasp_shift] * 3, errors.grasp_turn, errors.grasp_turn, yaw]),
        slip=errors.slip,
        slide=errors.slide,
        slip_at=slip_at,
        slide_at=float(slide.uniform()),
        slip_side=slip_side,
        arm=arm,
        joints=joints,
        gripper=gripper,
        delay=float(errors.delay[0] + (errors.delay[1] - errors.delay[0]) * delay.uniform()),
        gain=1.0 + errors.gain * float(_stream(seed, _GAIN).normal()),
        zero=errors.zero * zero_share * zero_force / float(np.linalg.norm(zero_force)),
        zero_along=zero_along / np.linalg.norm(zero_along),
        peg_growth=_growth(_stream(seed, _DIMENSIONS), errors.dimension, clearance),
    )


def parameter_spread(kinematic: float) -> Array:
    """Standard deviations (6, 4) of the arm's parameters, whose rms error at the bench is `kinematic` (m)."""
    return _PARAMETER_SPREAD * (kinematic / six_joint_arm.error_scale(REFERENCE, _PARAMETER_SPREAD))


def _compliances(seed: int, errors: BenchErrors) -> tuple[Array, Array]:
    """Of the joints (6,) and of the gripper (6,): their shares vary, the tip yields as is stated."""
    generator = _stream(seed, _BENDING)
    joints = _JOINTS * np.exp(COMPLIANCE_RATIO * generator.normal(size=6))
    gripper = _GRIPPER * np.exp(COMPLIANCE_RATIO * generator.normal(size=6))
    arm = six_joint_arm.nominal_arm()
    jacobian, _ = arm.jacobian(arm.inverse(six_joint_arm.matrices(REFERENCE)[None]))
    now = six_joint_arm.tip_compliance(six_joint_arm.chain_compliance(jacobian, joints, gripper)[0], TIP)
    factor = errors.compliance * math.exp(errors.compliance_spread * generator.normal()) / now
    return joints * factor, gripper * factor


def _growth(generator: np.random.Generator, spread: float, clearance: float) -> Array:
    while True:
        growth = spread * generator.normal(size=2)
        if growth[0] <= 0.25 * clearance:
            return np.asarray(growth)


def _stream(seed: int, which: int) -> np.random.Generator:
    return np.random.default_rng([seed, _STREAM, which])
