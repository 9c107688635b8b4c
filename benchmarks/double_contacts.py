"""Probes in which a peg touches in two places at once: wedged in a hole's mouth, and half in the hole.

They are planned from the truth: a belief after vision is off by more than the hole has to spare. What they
find is compared on the same recordings (`physics.py --double`), beside those of the usual probe.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import torch
from scenes import PARTICLES, default_run
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.geometry.holes import fit_in, hole_of
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.waypoints import DAMPING, STIFFNESS
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.robot.plan import Manner, Plan
from bcppl.sensors.measurements import Recording

ABOVE = 0.05  # m above the mouth where a probe begins
LEAN = math.radians(6.0)  # of a peg that wedges
INSIDE, PRESS = 0.01, 0.003  # m: how deep a peg is half in, and how far its command goes beyond a surface
FORCE = 6.0  # N that stop a guarded motion
_STREAM = 31  # of random numbers
USUAL = "3-2-1"  # the probe planned by the default model's vision


def along(scene: BenchScene, positions: Sequence[Sequence[float]], leans: Sequence[Sequence[float]]) -> Array:
    """Poses (K, 7) of a peg that fits the hole, its tip at positions (K, 3) of the hole's frame, m.

    It leans there by rotation vectors (K, 3) of that frame, rad, about its tip.
    """
    hole = hole_of(scene.part)
    world_from_hole = poses.compose(torch.from_numpy(scene.truth), torch.from_numpy(hole.part_from_hole))
    hole_from_peg = torch.from_numpy(fit_in(hole, scene.peg).hole_from_peg)
    tips = poses.identity(len(positions))
    tips[:, :3] = torch.tensor(np.array(positions), dtype=torch.float64)
    turns = torch.tensor(np.array(leans), dtype=torch.float64)
    tips = poses.retract(tips, torch.cat([torch.zeros_like(turns), turns], dim=1))
    standing: Tensor = poses.compose(poses.compose(world_from_hole, tips), hole_from_peg)
    return np.asarray(standing.numpy())


def planned(name: str, path: Array, spans: Sequence[float], manners: Sequence[Manner]) -> Plan:
    """A plan through poses (K, 7), with so many seconds between them."""
    times = np.concatenate([[0.0], np.cumsum(spans)])
    return Plan(name, times, path, tuple(manners), FORCE, np.array(STIFFNESS), np.array(DAMPING))


def wedged(scene: BenchScene) -> Plan:
    """A peg that leans is lowered into the mouth until it wedges, and is pressed to the four sides there."""
    rng = np.random.default_rng([scene.seed, _STREAM])
    heading, off = rng.uniform(0.0, 2.0 * math.pi), rng.normal(scale=0.0003, size=2)
    lean = LEAN * np.array([math.cos(heading), math.sin(heading), 0.0])
    down = -PRESS - 0.004
    sides = PRESS * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    positions = [[*off, ABOVE], [*off, 0.002], [*off, down], *[[*(off + side), down] for side in sides]]
    path = along(scene, positions, [lean] * len(positions))
    return planned("wedged", path, [1.2, 0.8, *[1.0] * 4], ["free", "guarded", *["held"] * 4])


def half_in(scene: BenchScene) -> Plan:
    """A peg is lowered into the hole, and leans and is pressed there to the four sides: rim and tip touch."""
    rng = np.random.default_rng([scene.seed, _STREAM])
    heading = rng.uniform(0.0, 2.0 * math.pi) + 0.5 * math.pi * np.arange(4)
    none, inside = [0.0, 0.0, 0.0], [0.0, 0.0, -INSIDE]
    leans = [[0.7 * LEAN * math.cos(a), 0.7 * LEAN * math.sin(a), 0.0] for a in heading]
    pressed = [[PRESS * math.sin(a), -PRESS * math.cos(a), -INSIDE] for a in heading]
    path = along(scene, [[0, 0, ABOVE], [0, 0, 0.002], inside, *pressed], [none] * 3 + leans)
    return planned("half in", path, [1.0, 1.0, *[1.0] * 4], ["free", "free", *["held"] * 4])


PLANS: dict[str, Callable[[BenchScene], Plan]] = {"wedged": wedged, "half in": half_in}


@cache
def recorded_scene(seed: int, noise: float, probe: str) -> tuple[BenchScene, Recording]:
    """A scene and its recording by one of `PLANS`, or by the usual probe."""
    scene = bench_scene(seed, BenchParameters(peg_noise=noise))
    if probe in PLANS:
        return scene, scene.probe(PLANS[probe](scene))
    *_, seen = default_run(scene.look(), PARTICLES, seed)
    return scene, scene.probe(three_two_one(seen.belief, scene.part, scene.peg))
