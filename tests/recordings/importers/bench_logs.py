"""Logs of a bench as its own software writes them, from a simulation: nothing here uses the importer.

The truth is a peg's poses and the wrench on it at 1 kHz: first a tool that is tilted in free air, then
touches in MuJoCo. The log has the flange's poses at 500 Hz in the base, quaternions x y z w; the wrench of a
sensor at the flange, turned against it, in its own axes, 1 kHz, with the tool's weight, a zero, and a clock
that is late.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.contact.physics import PegPhysics
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors import Recording

AIR = 6.0  # s in free air before the touches
MASS, CENTER = 0.9, np.array([0.01, -0.005, 0.06])  # kg; m in the sensor's frame
ZERO = np.array([3.0, -2.0, 5.0, 0.1, -0.2, 0.05])  # of the sensor, N and N m
# The flange's z points out of the arm, the peg's back into it; the sensor is turned against both.
FLANGE_FROM_PEG = (np.array([0.004, -0.003, 0.12]), Rotation.from_rotvec([np.pi, 0.0, 0.0]))
FLANGE_FROM_SENSOR = (
    np.array([0.0, 0.002, 0.03]),
    Rotation.from_euler("xyz", [10.0, -5.0, 35.0], degrees=True),
)


@dataclass(frozen=True, eq=False)
class Truth:
    """What was the case, at 1 kHz: times (T,) s, poses (T, 7) and wrenches (T, 6) in the peg's frame."""

    scene: BenchScene
    times: Any
    world_from_peg: Any
    wrench: Any


@functools.cache
def truth(seed: int, stiff: float = 1.0) -> Truth:
    """Touches of a scene of the bench, after tilting in free air."""
    scene = bench_scene(seed)
    place, spread = torch.from_numpy(scene.truth), torch.tensor([0.002] * 3 + [0.01] * 3).double()
    generator = torch.Generator().manual_seed(seed)
    near = poses.retract(
        place.expand(100, 7), spread * torch.randn(100, 6, generator=generator, dtype=torch.float64)
    )
    belief = Belief(near, torch.full((100,), -np.log(100.0), dtype=torch.float64))
    plan = three_two_one(belief, scene.part, scene.peg)
    plan = replace(plan, rate=200.0, stiffness=stiff * plan.stiffness, damping=stiff**0.5 * plan.damping)
    probe = scene.execute(plan)[0].probe
    count = round(1000.0 * (probe.stamps[-1] - probe.stamps[0]))
    probe = replace(probe, stamps=probe.stamps[0] + np.arange(count) / 1000.0)
    rollout = PegPhysics(scene.part, scene.peg, scene.contact).start(place[None], probe).advance(count)
    touched, wrench = rollout.world_from_peg[0], rollout.wrench[0]

    air = np.arange(round(1000.0 * AIR)) / 1000.0
    first = Rotation.from_quat(touched[0, [4, 5, 6, 3]])
    ramp = np.sin(np.pi * air / AIR) ** 2
    angles = (
        np.radians(40.0)
        * ramp[:, None]
        * np.stack([np.sin(2.0 * np.pi * air / 3.0), np.cos(2.0 * np.pi * air / 2.0), 0.0 * air], axis=1)
    )
    turned = (first * Rotation.from_rotvec(angles)).as_quat()[:, [3, 0, 1, 2]]
    lifted = touched[0, :3] + np.stack([0.0 * air, 0.0 * air, 0.05 * ramp], axis=1)
    return Truth(
        scene,
        np.concatenate([air, AIR + probe.stamps - probe.stamps[0]]),
        np.concatenate([np.column_stack([lifted, turned]), touched]),
        np.concatenate([np.zeros((len(air), 6)), wrench]),
    )


@dataclass(frozen=True)
class Log:
    """How a log is written; a field that differs from what the configuration states is a mistake in it.

    Attributes:
        late: of the wrench's clock, s.
        start: of the pose's clock, s.
        noise: standard deviations of force (N), torque (N m) and position (m).
        skip: rows of the wrench that are lost: (first, last).
        drift: of the wrench's clock, ppm.
        jumps: (when, s after the beginning of the log; by how much) the wrench's clock is set on.
        bends: m/N by which the encoders go on while the peg rests on the part.
        in_base: whether the wrench is a controller's: compensated, what the peg exerts, in the base's axes
            about the flange.
        seed: of the noise.
        more: lines of the configuration.
    """

    late: float = 0.008
    start: float = 5120.4
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    skip: tuple[tuple[int, int], ...] = ()
    drift: float = 0.0
    jumps: tuple[float, float] = (0.0, 0.0)
    bends: float = 0.0
    in_base: bool = False
    seed: int = 0
    more: dict[str, Any] = field(default_factory=dict)


def sensed(there: Truth) -> Any:
    """The wrench (T, 6) that the sensor reads, in its axes about its origin, with weight and zero."""
    peg = Rotation.from_quat(there.world_from_peg[:, [4, 5, 6, 3]])
    world_from_flange, flange = flanges(there.world_from_peg)
    at = flange + world_from_flange.apply(FLANGE_FROM_SENSOR[0])
    axes = world_from_flange * FLANGE_FROM_SENSOR[1]
    force, moment = peg.apply(there.wrench[:, :3]), peg.apply(there.wrench[:, 3:])
    # The moment about another point: that about the peg's origin, and the force with the lever to there.
    moment = moment + np.cross(there.world_from_peg[:, :3] - at, force)
    weight = np.array([0.0, 0.0, -9.80665 * MASS])
    moment = moment + np.cross(axes.apply(CENTER), weight)
    force = force + weight
    return np.concatenate([axes.inv().apply(force), axes.inv().apply(moment)], axis=1) + ZERO


def sensed_in_base(there: Truth) -> Any:
    """The wrench (T, 6) that the peg exerts, in the base's axes about the flange's origin."""
    peg = Rotation.from_quat(there.world_from_peg[:, [4, 5, 6, 3]])
    _, flange = flanges(there.world_from_peg)
    force = peg.apply(there.wrench[:, :3])
    moment = peg.apply(there.wrench[:, 3:]) + np.cross(there.world_from_peg[:, :3] - flange, force)
    return -np.concatenate([force, moment], axis=1)


def flanges(world_from_peg: Any) -> tuple[Rotation, Any]:
    """Rotations and positions (T, 3) of the flange that holds a peg at poses (T, 7)."""
    turn = Rotation.from_quat(world_from_peg[:, [4, 5, 6, 3]]) * FLANGE_FROM_PEG[1].inv()
    return turn, world_from_peg[:, :3] - turn.apply(FLANGE_FROM_PEG[0])


def write(folder: Path, there: Truth, log: Log | None = None) -> Path:
    """A folder of files, and the configuration of it; returns that."""
    log = Log() if log is None else log
    rng = np.random.default_rng(log.seed)
    readings = (sensed_in_base if log.in_base else sensed)(there) + rng.normal(
        size=(len(there.times), 6)
    ) * np.repeat(log.noise[:2], 3)
    stamps = log.start + there.times * (1.0 + 1e-6 * log.drift) + log.late
    stamps += np.where(there.times > log.jumps[0], log.jumps[1], 0.0)
    kept = np.ones(len(stamps), dtype=bool)
    for first, last in log.skip:
        kept[first:last] = False
    rows = np.column_stack([1e3 * stamps, readings[:, :3], 1e3 * readings[:, 3:]])[kept]  # ms, N, N mm
    np.savetxt(folder / "wrench.csv", rows, "%.6f", ",", header="t,fx,fy,fz,tx,ty,tz", comments="")

    measured = there.world_from_peg.copy()
    force = Rotation.from_quat(measured[:, [4, 5, 6, 3]]).apply(there.wrench[:, :3])
    measured[:, :3] += log.noise[2] * rng.normal(size=(len(measured), 3)) - log.bends * force
    turn, place = flanges(measured[::2])
    rows = np.column_stack([log.start + there.times[::2], 1e3 * place, turn.as_quat()])
    np.savetxt(folder / "poses.csv", rows, "%.9f", ",", header="t,x,y,z,qx,qy,qz,qw", comments="")

    scene = there.scene
    for name, part in (("part", scene.part), ("peg", scene.peg)):
        mesh = part.mesh.copy()
        mesh.apply_scale(1000.0)
        mesh.export(folder / f"{name}.stl")
    for k, view in enumerate(scene.look().measurements):
        depth = np.nan_to_num(1000.0 * view.observation.depth)
        Image.fromarray(np.round(depth).astype(np.uint16)).save(folder / f"view_{k}.png")
    path = folder / "bench.yaml"
    text = configuration(scene)
    if log.in_base:
        text = text.replace("axes: sensor", "axes: base").replace("about: sensor", "about: frame")
        text = text.replace("on_peg", "by_peg") + "gravity: {load: compensated}\n"
    path.write_text(text + "".join(f"{k}: {v}\n" for k, v in log.more.items()), encoding="utf-8")
    return path


def configuration(scene: BenchScene) -> str:
    """The configuration of the log, as a user writes it."""
    x, y, z = 1000.0 * FLANGE_FROM_PEG[0]
    sensor_x, sensor_y, sensor_z = 1000.0 * FLANGE_FROM_SENSOR[0]
    turn = ", ".join(f"{q:.12f}" for q in FLANGE_FROM_SENSOR[1].as_quat())
    guess = ", ".join(f"{c:.12f}" for c in scene.guess.world_from_part[:3])
    cameras = ""
    for k, camera in enumerate(scene.cameras):
        at, q = (camera.world_from_camera[s] for s in (slice(3), slice(3, 7)))
        cameras += (
            f"  camera_{k}: {{fx: {camera.fx}, fy: {camera.fy}, cx: {camera.cx}, cy: {camera.cy}, near: 0.1,"
            f" far: 2.0, unit: mm,\n    world_from_camera: {{xyz: {at.tolist()}, wxyz: {q.tolist()}}},\n"
            f"    images: [{{file: view_{k}.png}}]}}\n"
        )
    return f"""\
part: {{mesh: part.stl, length: mm}}
peg: {{mesh: peg.stl, length: mm}}
guess:
  world_from_part: {{xyz: [{guess}]}}
  translation: [20, 20, 20]
  length: mm
  tilt: 10
  yaw: 30
  angle: deg
wrench:
  file: wrench.csv
  time: {{column: t, unit: ms}}
  columns: [fx, fy, fz, tx, ty, tz]
  force: N
  torque: Nmm
  axes: sensor
  about: sensor
  sign: on_peg
pose:
  file: poses.csv
  time: {{column: t, unit: s}}
  columns: [x, y, z, qx, qy, qz, qw]
  rotation: xyzw
  length: mm
frame_from_peg: {{xyz: [{x}, {y}, {z}], length: mm, vector: [180, 0, 0], angle: deg}}
frame_from_sensor: {{xyz: [{sensor_x}, {sensor_y}, {sensor_z}], length: mm, xyzw: [{turn}]}}
cameras:
{cameras}"""


def touches(recording: Recording) -> tuple[Any, Any, Any]:
    """Times (T,), wrenches (T, 6) and poses (T, 7) of all windows."""
    seen = [m.observation for m in recording.measurements if m.kind == "window"]
    times, wrench, peg = (
        np.concatenate([getattr(o, name) for o in seen]) for name in ("times", "wrench", "world_from_peg")
    )
    return times, wrench, peg


def truth_at(there: Truth, times: Any, width: float) -> tuple[Any, Any]:
    """The true wrench, averaged over some seconds about times (T,), and the true pose."""
    fine = np.linspace(-0.5, 0.5, 41) * width
    weights = np.ones(41) / 40.0
    weights[[0, -1]] /= 2.0
    wrench = np.stack(
        [sum(w * np.interp(times + d, there.times, c) for d, w in zip(fine, weights, strict=True))
         for c in there.wrench.T], axis=1,
    )  # fmt: skip
    turns = Slerp(there.times, Rotation.from_quat(there.world_from_peg[:, [4, 5, 6, 3]]))(times)
    place = np.stack([np.interp(times, there.times, c) for c in there.world_from_peg[:, :3].T], axis=1)
    return wrench, np.column_stack([place, turns.as_quat()[:, [3, 0, 1, 2]]])
