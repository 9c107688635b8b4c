"""An arm of six joints under impedance control, a peg at its wrist sensor, and a part, in MuJoCo.

Joints have dry friction, the controller follows its command with a lag, the sensor carries the peg's weight
and inertia, and contact is a spring and a damper of stated stiffness. The peg in the hand and the part may be
displaced while it moves: the arm does not know of it.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from scipy.signal import butter, lfilter, lfilter_zi

from bcppl.arrays import Array
from bcppl.geometry.parts import Part

Motion = Generator[Array, float, None]  # yields commanded poses (7,), is sent the force that is felt, N

STEP = 1e-4  # s of physics
TICK = 10  # steps of a tick of the controller
NOMINAL = 1e6  # N/m: 3 to 8 N press a nominal contact in by less than 10 um
SHARE = 0.1  # of MuJoCo's impedance: small, so that a contact is the spring that it is asked to be

ARM = """
<mujoco>
  <option timestep="{step}" cone="elliptic" impratio="20" integrator="implicitfast" tolerance="1e-10"/>
  <compiler angle="radian"/>
  <default><joint damping="0.02"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 0.30">
      <inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
      <joint axis="0 0 1" frictionloss="{f[0]}" armature="0.03"/>
      <body>
        <inertial pos="0 0 0.15" mass="1.6" diaginertia="0.012 0.012 0.002"/>
        <joint axis="0 1 0" frictionloss="{f[1]}" armature="0.03"/>
        <body pos="0 0 0.36">
          <inertial pos="0.13 0 0" mass="0.9" diaginertia="0.001 0.006 0.006"/>
          <joint axis="0 1 0" frictionloss="{f[2]}" armature="0.02"/>
          <body pos="0.36 0 0">
            <inertial pos="0 0 0" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/>
            <joint axis="1 0 0" frictionloss="{f[3]}" armature="0.004"/>
            <body>
              <inertial pos="0 0 0" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/>
              <joint axis="0 1 0" frictionloss="{f[4]}" armature="0.004"/>
              <body>
                <inertial pos="0 0 -0.02" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/>
                <joint axis="0 0 1" frictionloss="{f[5]}" armature="0.002"/>
                <body name="peg" pos="0 0 -0.06">
                  <inertial pos="0 0 -0.04" mass="{mass}" diaginertia="2e-4 2e-4 3e-5"/>
                  <site name="sensor"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <sensor><force site="sensor"/><torque site="sensor"/></sensor>
</mujoco>
"""


@dataclass(frozen=True)
class Mechanics:
    """What differs from scene to scene; of it a recording states only `spring` and `damper`.

    Attributes:
        stiffness: of contact, N/m.
        restitution: the damping ratio of contact for a mass of 0.5 kg.
        friction: between peg and part.
        joint_friction: of the shoulder, N m; joints towards the wrist have less.
        tool_mass: below the sensor, kg.
        lag: time constant of the controller's command, s.
        cut_off: of the sensor's low-pass filter of second order, Hz.
        spring, damper: (6,) N/m and N m/rad; N s/m and N m s/rad, of the impedance control.
    """

    stiffness: float
    restitution: float
    friction: float
    joint_friction: float
    tool_mass: float
    lag: float
    cut_off: float
    spring: Array
    damper: Array


class Log(NamedTuple):
    """What happened, at every tick: `command` as asked for, the rest as it was.

    Attributes:
        times: (T,) s.
        command, world_from_peg: (T, 7).
        wrench: (T, 6) after the sensor's filter, without noise.
        depth: (T,) penetration of the deepest contact, m; -inf without one.
        force: (T,) sum of the contacts' normal forces, N.
    """

    times: Array
    command: Array
    world_from_peg: Array
    wrench: Array
    depth: Array
    force: Array


class Hidden(Protocol):
    """What the arm does not know of: how the peg is held, and where the part is.

    Attributes:
        stated_from_peg: (7,) the true peg in the frame that the arm takes for the peg's, the sensor's.
        world_from_part: (7,).
    """

    stated_from_peg: Array
    world_from_part: Array

    def felt(self, stated: Array, force: Array, point: Array) -> None:
        """Take note of a tick, at whose end the two are put where both poses then are.

        Args:
            stated: (7,) world_from_stated at the start of the tick.
            force: (3,) of the part on the peg then, N, in the world.
            point: (3,) mean of the contacts' points, m, in the world; zeros without contact.
        """


def carried_out(
    motion: Motion,
    seconds: float,
    part: Part,
    peg: Part,
    truth: Array,
    mechanics: Mechanics,
    hidden: Hidden | None = None,
) -> Log:
    """The log of a motion, after whose end the command stays where it is.

    Args:
        motion: yields a command at every tick; the first is where the arm stands.
        seconds: to simulate.
        part: its pieces collide with those of the peg.
        peg: its frame is the wrench sensor's.
        truth: (7,) world_from_part.
        mechanics: of the arm and the contact.
        hidden: displaces peg and part; the log's poses are then those of the peg as stated.
    """
    model = _model(part, peg, truth, mechanics)
    data = mujoco.MjData(model)
    displaced = _Displaced(model, data, hidden) if hidden is not None else None
    command = next(motion)
    _stand(model, data, command)
    sensor = _Sensor(mechanics.cut_off)
    followed, share = command, 1.0 - np.exp(-STEP * TICK / mechanics.lag)
    jacobian = np.zeros((6, model.nv))
    rows: list[tuple[Array, ...]] = []
    for _ in range(round(seconds / (STEP * TICK))):
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], 0)
        followed = _towards(followed, command, share)
        away = _away(data, followed)
        push = jacobian.T @ (mechanics.spring * away - mechanics.damper * (jacobian @ data.qvel))
        readings = np.empty((TICK, 6))
        for k in range(TICK):
            data.qfrc_applied[:] = push + data.qfrc_bias
            mujoco.mj_step(model, data)
            # MuJoCo's readings, places and contacts are of the state before the step; its wrench is that of
            # the wrist on the peg, the opposite of what the part, gravity and inertia exert.
            readings[k] = -data.sensordata
            if k == 0:
                reached = np.append(data.site_xpos[0], _turn(data))
                contact = _contact(model, data)
                if hidden is not None:
                    hidden.felt(reached, *_force_on_peg(model, data))
        wrench = sensor.filtered(readings)
        rows.append((command, reached, wrench[0], contact))
        if displaced is not None:
            displaced.place()
        command = _next(motion, sensor.force(wrench[-1]), command)
    times = STEP * TICK * np.arange(len(rows))
    commands, reached, wrench, contact = (np.array(column) for column in zip(*rows, strict=True))
    return Log(times, commands, reached, wrench, *contact.T)


class _Sensor:
    """The wrist sensor's filter, and the force that the controller takes for that of contact."""

    def __init__(self, cut_off: float) -> None:
        b, a = butter(2, cut_off, fs=1.0 / STEP)
        self._steady = lfilter_zi(b, a)[:, None]
        # A tick of the filter as a matrix: its outputs and its next state are linear in inputs and state.
        inputs, state = np.split(np.eye(TICK + 2), [TICK])
        self._tick = np.vstack(lfilter(b, a, inputs, axis=0, zi=state))
        self._state: Array | None = None
        self._zero = np.zeros(3)

    def filtered(self, readings: Array) -> Array:
        """Wrenches (T, 6) after the filter, which starts as if the first reading had always been there."""
        if self._state is None:
            self._state = self._steady * readings[0]
            self._zero = readings[0, :3].copy()
        wrench, self._state = np.split(self._tick @ np.vstack([readings, self._state]), [TICK])
        return wrench

    def force(self, wrench: Array) -> float:
        """The length of the force (N) beyond that at the start."""
        return float(np.linalg.norm(wrench[:3] - self._zero))


class _Displaced:
    """The peg in the hand and the part, put where they are hidden to be."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, hidden: Hidden) -> None:
        self._model, self._data, self._hidden = model, data, hidden
        self._geoms = np.flatnonzero(model.geom_bodyid == model.body("peg").id)
        self._held = np.hstack([model.geom_pos[self._geoms], model.geom_quat[self._geoms]])
        # Shortcuts for geometries that stay in their bodies.
        model.geom_sameframe[:] = 0
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        self.place()

    def place(self) -> None:
        """Put both where they are now."""
        for geom, held in zip(self._geoms, self._held, strict=True):
            pose = composed(self._hidden.stated_from_peg, held)
            self._model.geom_pos[geom], self._model.geom_quat[geom] = pose[:3], pose[3:]
        self._data.mocap_pos[0] = self._hidden.world_from_part[:3]
        self._data.mocap_quat[0] = self._hidden.world_from_part[3:]


def composed(a_from_b: Array, b_from_c: Array) -> Array:
    """The pose (7,) a_from_c."""
    pose = np.zeros(7)
    mujoco.mju_mulPose(pose[:3], pose[3:], a_from_b[:3], a_from_b[3:], b_from_c[:3], b_from_c[3:])
    return pose


def inverse(a_from_b: Array) -> Array:
    """The pose (7,) b_from_a."""
    pose = np.zeros(7)
    mujoco.mju_negPose(pose[:3], pose[3:], a_from_b[:3], a_from_b[3:])
    return pose


def _next(motion: Motion, force: float, last: Array) -> Array:
    try:
        return motion.send(force)
    except StopIteration:
        return last


def _towards(pose: Array, goal: Array, share: float) -> Array:
    quaternion = goal[3:] if pose[3:] @ goal[3:] >= 0.0 else -goal[3:]
    moved = pose + share * (np.append(goal[:3], quaternion) - pose)
    moved[3:] /= np.linalg.norm(moved[3:])
    return moved


def _turn(data: mujoco.MjData) -> Array:
    """The sensor's quaternion, wxyz; scipy's conversion takes as long as several steps of physics."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, data.site_xmat[0])
    return quaternion


def _away(data: mujoco.MjData, pose: Array) -> Array:
    """From the sensor to a pose (7,): translation and rotation vector (6,) along the world's axes."""
    turn = np.zeros(3)
    mujoco.mju_subQuat(turn, pose[3:], _turn(data))
    return np.append(pose[:3] - data.site_xpos[0], data.site_xmat[0].reshape(3, 3) @ turn)


def _contact(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Penetration (m) of the deepest contact, -inf without one, and the sum of normal forces (N)."""
    wrench, force = np.zeros(6), 0.0
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, wrench)
        force += wrench[0]
    return np.array([-min(data.contact.dist, default=np.inf), force])


def _force_on_peg(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array]:
    """The part's force on the peg (3,), N, and the mean of the contacts' points (3,), m, in the world."""
    wrench, force, point, peg = np.zeros(6), np.zeros(3), np.zeros(3), model.body("peg").id
    for k in range(data.ncon):
        contact = data.contact[k]
        mujoco.mj_contactForce(model, data, k, wrench)
        sign = 1.0 if model.geom_bodyid[contact.geom2] == peg else -1.0
        force += sign * contact.frame.reshape(3, 3).T @ wrench[:3]
        point += contact.pos / data.ncon
    return force, point


def _model(part: Part, peg: Part, truth: Array, mechanics: Mechanics) -> mujoco.MjModel:
    joints = mechanics.joint_friction * np.array([1.0, 1.0, 0.7, 0.15, 0.15, 0.1])
    spec = mujoco.MjSpec.from_string(ARM.format(step=STEP, f=joints, mass=mechanics.tool_mass))
    fixed = spec.worldbody.add_body(pos=truth[:3], quat=truth[3:], mocap=True)
    for name, body, solid, collides in (("peg", spec.body("peg"), peg, 1), ("part", fixed, part, 2)):
        for k, piece in enumerate(solid.pieces):
            geom = body.add_geom(friction=[mechanics.friction, 0.0, 0.0], condim=3)
            geom.contype, geom.conaffinity = collides, 3 - collides
            geom.solimp[:3] = SHARE, SHARE, 0.001
            if piece.kind == "box":
                geom.type, geom.size, geom.pos = mujoco.mjtGeom.mjGEOM_BOX, piece.size, piece.center
            else:
                mesh = spec.add_mesh(name=f"{name}_{k}", uservert=np.ravel(piece.size))
                geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
    model = spec.compile()
    # A contact's force is (-b v - k r - a) / R with R = (1 - d) A / d; solref's k and b are divided by d.
    inverse_mass = model.body_invweight0[model.body("peg").id, 0]
    damper = 2.0 * mechanics.restitution * np.sqrt(0.5 * mechanics.stiffness)
    model.geom_solref[:] = -(1.0 - SHARE) * inverse_mass * np.array([mechanics.stiffness, damper])
    return model


def _stand(model: mujoco.MjModel, data: mujoco.MjData, pose: Array) -> None:
    """Set the joints so that the sensor is at a pose, by damped least squares."""
    jacobian = np.zeros((6, model.nv))
    for _ in range(200):
        mujoco.mj_forward(model, data)
        away = _away(data, pose)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], 0)
        damped = jacobian @ jacobian.T + 1e-6 * np.eye(6)
        data.qpos += np.clip(jacobian.T @ np.linalg.solve(damped, away), -0.2, 0.2)
    mujoco.mj_forward(model, data)
    if np.linalg.norm(away) > 1e-6:
        raise ValueError(f"the arm does not reach the pose {pose}")
