"""Depth-only cases: a box before a coarse camera."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyro
import torch
import trimesh

from bcppl import poses
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.poses import NormalPose
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.inference.filters.tempered_smc import kernel as shipped
from bcppl.inference.kernels import cycle, metropolis_hastings, repeat
from bcppl.inference.proposals import depth_alignment, drift, independent
from bcppl.poses import FREE, Freedom
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import Trace
from tests.calibration.case import Case

CAMERA = Camera("coarse", 16, 12, 16.0, 16.0, 7.5, 5.5, np.array([0.0, 0, 0, 1, 0, 0, 0]), near=0.05, far=1.5)
CENTER = poses.as_pose([0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0])


def box() -> Part:
    """A box of 12 x 8 x 5 cm, its frame in its middle: a half turn about any of its axes changes nothing."""
    mesh = trimesh.creation.box((0.12, 0.08, 0.05))
    return Part("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))


RENDERER = RayCaster(box())


class Seen:
    """The program: a pose from a normal prior, and a depth image of the box."""

    def __init__(self, spread: tuple[float, ...], freedom: Freedom, scale: float, outlier: float) -> None:
        self.spread, self.freedom = torch.tensor(spread, dtype=torch.float64), freedom
        self.scale, self.outlier = scale, outlier

    def __call__(self, count: int) -> None:
        pose = pyro.sample("pose", NormalPose(CENTER, self.spread, self.freedom))
        if count:
            seen = RobustDepth(RENDERER, CAMERA, pose, self.scale, outlier=self.outlier)
            pyro.sample("seen", seen)


OVER = poses.retract(CENTER, torch.tensor([0.0, 0.0, 0.0, math.pi, 0.0, 0.0], dtype=torch.float64))
OVER_SPREAD = torch.tensor([0.02, 0.02, 0.02, 1.2, 1.2, 1.2], dtype=torch.float64)


def turned_over(trace: Trace) -> None:
    """An independent pose about the box lying on its other side, wherever the particle is."""
    pyro.sample("pose", NormalPose(OVER.expand(len(trace), 7), OVER_SPREAD))


def six_axes(scale: float = 0.04, believed: float | None = None) -> Case:
    """Wide rotations, weakly seen: there their measure counts; a box turned over looks alike."""
    spread, outlier = (0.02, 0.02, 0.02, 1.3, 1.3, 1.3), 0.4
    program = Seen(spread, FREE, scale, outlier)
    inferred = Seen(spread, FREE, believed or scale, outlier)
    # Not the shipped kernel: its normal, fitted about the prior's centre, takes back half of what a prior
    # without Jacobian does wrong.
    over = repeat(metropolis_hastings(turned_over), 3)
    kernel = cycle(metropolis_hastings(drift("pose", (0.2, 2.0))), over)
    return Case(program, CENTER, FREE, kernel, inferred, sweeps=6, settling=10)


def planar(scale: float = 0.015, believed: float | None = None) -> Case:
    """On a table: two translations and a turn, well seen."""
    spread, freedom, outlier = (0.03, 0.03, 0.4), Freedom("xy", "z"), 0.1
    program = Seen(spread, freedom, scale, outlier)
    inferred = Seen(spread, freedom, believed or scale, outlier)
    kernel = cycle(shipped("pose"), metropolis_hastings(independent("pose", components=None)))
    return Case(program, CENTER, freedom, kernel, inferred, sweeps=6, settling=10)


def upright(scale: float = 0.015, believed: float | None = None) -> Case:
    """In a plane that holds the optical axis, where the noise determines how well two axes are known."""
    spread, freedom, outlier = (0.03, 0.03, 0.4), Freedom("xz", "y"), 0.1
    program = Seen(spread, freedom, scale, outlier)
    inferred = Seen(spread, freedom, believed or scale, outlier)
    return Case(program, CENTER, freedom, shipped("pose"), inferred, sweeps=6, settling=10)


def quick() -> Case:
    """As `planar`, with few particles and a random walk alone: for the ordinary tests."""
    kernel = metropolis_hastings(drift("pose", (0.2, 2.0)))
    return replace(planar(), kernel=kernel, particles=50, sweeps=3, settling=3)


def aligned() -> Case:
    """As `planar`, moved only by what brings the rendered points onto the measured depth."""
    return replace(planar(), kernel=metropolis_hastings(depth_alignment("pose", "seen")))
