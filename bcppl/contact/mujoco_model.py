"""The MuJoCo model of a peg that a Cartesian spring-damper holds, and of a part."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from bcppl.arguments import number_within
from bcppl.arrays import Array, Indices
from bcppl.errors import InputError
from bcppl.geometry.parts import Part, Piece
from bcppl.robot.commands import interpolated_command
from bcppl.robot.motion import Probe

SENSOR_COLUMNS = 16  # of a sensor row: position 3, quaternion 4, force 3, torque 3, normal 3
_LARGEST_FORCE = 2  # of the ways in which MuJoCo's contact sensor chooses one of several contacts


@dataclass(frozen=True)
class ContactParameters:
    """Parameters of contact physics, apart from poses and the probe.

    Attributes:
        time_step: seconds. Lowered into a hole and sliding in it, a peg departs from its path at 0.25 ms by
            at most 5 um at 1 ms, 13 at 2 and 19 at 4 (medians over poses), except at the rim of the hole.
        friction: Coulomb's coefficient between peg and part.
        time_constant: of a contact, seconds (MuJoCo's solref, which has a lower bound of two time steps).
        damping_ratio: of a contact; 1 is critical.
        impedance: MuJoCo's solimp (5,): the initial and the final impedance, and the penetration (m) between
            them. With a high initial impedance contacts chatter: at 3 N of steady sliding the force went from
            0.3 to 8 N within three steps at any time step. With the default it is steady within 1 mN, and the
            penetration is 5 um at 3 N, 12 um at 20 N on a face, 45 um at 17 N on a corner.
        arm_mass: effective mass of the arm at the wrench sensor, kg.
        arm_inertia: effective inertia of the arm about the wrench sensor, kg m^2.
        tool_mass: mass below the wrench sensor, whose inertial force the sensor measures, kg.
        elliptic: whether friction cones are elliptic rather than pyramidal.
        impratio: ratio of the impedances of friction and normal force: 100 keeps a resting peg from creeping.
    """

    time_step: float = 0.002
    friction: float = 0.3
    time_constant: float = 0.004
    damping_ratio: float = 1.0
    impedance: tuple[float, float, float, float, float] = (0.1, 0.95, 0.00005, 0.5, 1.0)
    arm_mass: float = 2.0
    arm_inertia: float = 0.02
    tool_mass: float = 0.2
    elliptic: bool = True
    impratio: float = 100.0

    def __post_init__(self) -> None:
        positive = ("time_step", "time_constant", "damping_ratio", "arm_mass", "arm_inertia", "tool_mass")
        for field in (*positive, "impratio"):
            number_within(f"contact parameter {field} is {{}}", getattr(self, field), above=0.0)
        number_within("contact parameter friction is {}", self.friction, least=0.0)
        for value in self.impedance:
            number_within("contact parameter impedance has {}", value, least=0.0)


def pieces_of(part: Part) -> Sequence[Piece]:
    """The convex pieces of a part in contact: its own, or its hull where its mesh is convex.

    The time grows with their number: in the hole, one simulated second took 19 ms with 4 pieces of the part,
    51 with 16, and 217 with 64.

    Raises:
        InputError: the part has no pieces and its mesh is not convex.
    """
    if part.pieces:
        return part.pieces
    if not part.mesh.is_convex:
        raise InputError(
            f"part {part.name!r} has no convex pieces and its mesh is not convex, so contact cannot be "
            "simulated; give it convex pieces with `bcppl.geometry.extrusion.extruded` (from its "
            "outline), `bcppl.geometry.layers.prismatic` (upright walls) or "
            "`bcppl.geometry.convex.decomposition.decomposed` (any mesh)."
        )
    return [Piece("hull", np.asarray(part.mesh.convex_hull.vertices, dtype=np.float64))]


def _add_pieces(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, part: Part, mass: float, parameters: ContactParameters
) -> None:
    pieces = pieces_of(part)
    kinds = {
        "box": mujoco.mjtGeom.mjGEOM_BOX,
        "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
        "hull": mujoco.mjtGeom.mjGEOM_MESH,
    }
    for k, piece in enumerate(pieces):
        geom = body.add_geom(type=kinds[piece.kind])
        if piece.kind == "hull":
            name = f"{body.name} {k}"
            spec.add_mesh(name=name, uservert=np.asarray(piece.size, dtype=np.float32).reshape(-1))
            geom.meshname = name
        else:
            geom.size = np.concatenate([np.asarray(piece.size, dtype=np.float64), np.zeros(3)])[:3]
            geom.pos = np.asarray(piece.center, dtype=np.float64)
        geom.mass = mass / len(pieces)
        geom.condim = 3
        geom.friction = [parameters.friction, 0.0, 0.0]
        geom.solref = [parameters.time_constant, parameters.damping_ratio]
        geom.solimp = list(parameters.impedance)


def build_model(part: Part, peg: Part, parameters: ContactParameters) -> mujoco.MjModel:
    """A model with bodies "part" and "command" (mocap), "flange" (free) and "peg" (fixed below the flange).

    Six actuators pull the peg's origin to the command's, along and about the command's axes:
    force = control - stiffness * displacement - damping * velocity; `set_controller` sets the two constants.
    Sensors, in order: the peg's position and quaternion, and the flange's force and torque on the peg, in the
    peg's frame about its origin: the negative of the environment's wrench on the peg; and the normal of the
    contact with the largest force, from the part into the peg, in the world, 0 without any. Gravity is
    compensated.
    The state is position, velocity and time.

    Raises:
        InputError: the part or the peg has no convex pieces and is not convex.
    """
    if peg.vertices[:, 2].min() >= 0.0:
        warnings.warn(
            f"peg {peg.name!r} lies wholly above its origin, where it is held; a peg hangs below it, so "
            "move it with `Part.moved` unless its z axis points down to the tip.",
            RuntimeWarning,
            stacklevel=3,
        )
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = parameters.time_step
    option.gravity = [0.0, 0.0, 0.0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    cone = mujoco.mjtCone
    option.cone = cone.mjCONE_ELLIPTIC if parameters.elliptic else cone.mjCONE_PYRAMIDAL
    option.impratio = parameters.impratio
    # A chunk of a rollout begins without a warm start: without any, chunks equal the whole to the bit.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # One free body is one island: to look for others takes time.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)

    # The order of the mocap bodies is the order of their poses in `mujoco.rollout`'s control.
    command = spec.worldbody.add_body(name="command", mocap=True)
    command.add_site(name="command")
    fixed = spec.worldbody.add_body(name="part", mocap=True)
    _add_pieces(spec, fixed, part, 1.0, parameters)
    flange = spec.worldbody.add_body(name="flange", mass=parameters.arm_mass, explicitinertial=True)
    flange.inertia = [parameters.arm_inertia] * 3
    flange.add_freejoint()
    held = flange.add_body(name="peg")
    _add_pieces(spec, held, peg, parameters.tool_mass, parameters)
    held.add_site(name="grip")

    for axis in range(6):
        gear = [0.0] * 6
        gear[axis] = 1.0
        spec.add_actuator(
            name=f"hold {axis}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target="grip",
            refsite="command",
            gear=gear,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        ).gainprm[0] = 1.0
    kinds = mujoco.mjtSensor
    for kind in (kinds.mjSENS_FRAMEPOS, kinds.mjSENS_FRAMEQUAT, kinds.mjSENS_FORCE, kinds.mjSENS_TORQUE):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="grip")
    body, normal = mujoco.mjtObj.mjOBJ_BODY, 1 << int(mujoco.mjtConDataField.mjCONDATA_NORMAL)
    spec.add_sensor(
        type=kinds.mjSENS_CONTACT,
        objtype=body,
        objname="part",
        reftype=body,
        refname="peg",
        intprm=[normal, _LARGEST_FORCE, 1],
    )
    model: mujoco.MjModel = spec.compile()
    return model


def set_controller(model: mujoco.MjModel, probe: Probe) -> None:
    """Set the spring-damper's constants of a model from `build_model` to those of a probe."""
    model.actuator_biasprm[:, 1] = -np.asarray(probe.stiffness)
    model.actuator_biasprm[:, 2] = -np.asarray(probe.damping)


def check_probe(probe: Probe) -> None:
    """Refuse a probe that cannot be simulated.

    Raises:
        InputError: times do not increase, shapes do not fit, a number is not finite, a constant of the
            controller is negative, or a stamp is before the command's first time.
    """
    for name, values in (("stiffness", probe.stiffness), ("damping", probe.damping)):
        values = np.asarray(values, dtype=np.float64)
        if values.shape != (6,) or not (np.isfinite(values).all() and (values >= 0).all()):
            raise InputError(
                f"probe {probe.name!r} has {name} {values.tolist()}; give six numbers, none of them negative."
            )
    times, command, stamps = probe.command_times, probe.command, probe.stamps
    increase = all(np.isfinite(t).all() and (np.diff(t) > 0).all() for t in (times, stamps))
    if command.shape != (len(times), 7) or not np.isfinite(command).all() or not increase:
        raise InputError(
            f"probe {probe.name!r} has {len(times)} command times, {len(stamps)} stamps and commands "
            f"{command.shape}; give finite times that increase and a finite pose (7,) for each command time."
        )
    if len(stamps) and stamps[0] < times[0] - 1e-9:
        raise InputError(
            f"probe {probe.name!r} has its first stamp at {stamps[0]:g} s, before its first command at "
            f"{times[0]:g} s; begin the command no later than the first stamp."
        )


def rollout_controls(probe: Probe, times: Array) -> Array:
    """Inputs (S, 13) of `mujoco.rollout` at times (S,): controls 6, the command's pose 7.

    The control is damping * commanded twist, so that the damping acts on the peg's velocity relative to the
    command's, and a peg in free motion follows without lag.
    """
    pose, twist = interpolated_command(probe, times)
    return np.concatenate([twist * np.asarray(probe.damping), pose], axis=1)


def steps_around(probe: Probe, time_step: float) -> tuple[Indices, Indices, Array]:
    """The steps before and after each stamp, (T,) each, and the weight (T,) of the second.

    Stamps within a nanosecond of a step are taken from that step alone.
    """
    position = (probe.stamps - probe.command_times[0]) / time_step
    nearest = np.rint(position)
    exact = np.abs(position - nearest) * time_step < 1e-9
    low = np.where(exact, nearest, np.floor(position)).astype(np.int64)
    high = np.where(exact, low, low + 1)
    return low, high, np.where(exact, 0.0, position - low)
