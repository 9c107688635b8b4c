"""How well an arm's own kinematics and its camera are calibrated, on real recordings.

Ball in socket: two tool positions teach the arm (joint offsets, where the ball is, errors of the joints'
origins), the others test it: how far apart are the two sockets, which are 50 mm apart. The nominal URDF
is known; no distance is. With `--offsets` the offsets and the ball are latent and the drawing is taken for
right. xArm: five depth images of an arm in which the camera's pose is latent, from a guess up to 50 mm along
each axis and 5 degrees off, without and with the masks that come with them; the reference is another method's
estimate, not a truth. Beside it stands where nearest points put the camera (`icp.py`).
"""

from __future__ import annotations

import itertools
import math
import time
from typing import NamedTuple

import numpy as np
import torch
from icp import nearest_points
from PIL import Image
from report import DATA, Row, finish, options, show

from bcppl import poses
from bcppl.distributions.poses import prior_from_guess
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Guess
from bcppl.inference.importance import importance_sampling
from bcppl.inference.summaries import mean
from bcppl.models.arm_calibration import (
    Arm,
    arm_calibration,
    laplace_proposal,
    observations,
    read_seatings,
    sockets,
)
from bcppl.models.arm_in_view import arm_in_view, fitted_proposal, observations as images_of, prepare
from bcppl.recordings.importers.bop import draw
from bcppl.robot.kinematics import Robot

BALL = DATA / "ball_in_socket"
XARM = DATA / "xarm7_realsense"
APART = 50.0  # mm
WITHIN = 0.4  # mm
PARTICLES = 300
CAMERAS = 200  # particles of the camera's pose
OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # optical_from_body


class Read(NamedTuple):
    """One distance: at a test position, mean and spread of the belief, and the nominal arm's, mm."""

    mean: float
    spread: float
    nominal: float
    covered: bool


def calibrated(name: str, count: int | None, seed: int, offsets_only: bool) -> tuple[list[list[Read]], float]:
    """The distances after each pair of positions that teaches, and the seconds of a pair."""
    robot = Robot(BALL / "urdf/panda.urdf", tip="ball_link")
    arm = Arm(robot, shift=0.0, turn=0.0) if offsets_only else Arm(robot)
    data = {p.name: read_seatings(p) for p in sorted((BALL / "data" / name).iterdir())}
    pairs = list(itertools.combinations(data, 2))
    order = np.random.default_rng(seed).permutation(len(pairs))[:count]
    found, begun = [], time.perf_counter()
    for k in sorted(order):
        torch.manual_seed(seed)
        seen = [q for place in pairs[k] for q in data[place]]
        population = importance_sampling(
            arm_calibration, (arm, seen), observations(seen), PARTICLES, laplace_proposal(arm, seen)
        )
        reads = []
        for place, (first, second) in data.items():
            if place in pairs[k]:
                continue
            apart = sockets(arm, population.trace, first) - sockets(arm, population.trace, second)
            distance = 1e3 * apart.norm(dim=1)
            weights = population.log_weights.softmax(dim=0)
            middle = float(weights @ distance)
            spread = float((weights @ (distance - middle) ** 2).sqrt())
            drawn = [robot.position("ball_link", q).mean(dim=0) for q in (first, second)]
            nominal = 1e3 * float((drawn[0] - drawn[1]).norm())
            # The interval of a normal: belief and nominal distance are close to one.
            reads.append(Read(middle, spread, nominal, abs(middle - APART) < 1.645 * spread))
        found.append(reads)
    return found, (time.perf_counter() - begun) / len(order)


def calibration(quick: bool, seed: int, offsets_only: bool) -> list[Row]:
    rows, lines = [], []
    for name in ("panda_2_clean", "panda_3"):
        found, seconds = calibrated(name, 2 if quick else None, seed, offsets_only)
        reads = [read for pair in found for read in pair]
        off = np.array([read.mean for read in reads]) - APART
        nominal = np.array([read.nominal for read in reads])
        spread = float(np.mean([read.spread for read in reads]))
        covered = 100.0 * float(np.mean([read.covered for read in reads]))
        within = 100.0 * float((np.abs(off) <= WITHIN).mean())
        lines.append(
            [
                name,
                len(found),
                len(reads),
                f"{nominal.min():.1f} to {nominal.max():.1f}",
                float(off.mean()),
                float(np.abs(off).max()),
                spread,
                covered,
                within,
                seconds,
            ]
        )
        rows += [
            Row(f"{name}: distance off, worst", float(np.abs(off).max()), "mm", WITHIN),
            Row(f"{name}: distance off, mean", float(off.mean()), "mm"),
            Row(f"{name}: within {WITHIN} mm", within, "% of tests", direction="min"),
            Row(f"{name}: 90 % intervals that hold 50 mm", covered, "% of tests", direction="min"),
            Row(f"{name}: seconds for a pair", seconds, "s"),
        ]
    latent = "offsets and ball" if offsets_only else "offsets, ball and origins"
    columns = ["", "pairs", "tests", "nominal mm", "mean off", "worst off", "spread", "90 % hold", "within %"]
    show(f"ball in socket: sockets {APART:g} mm apart, latent {latent}, mm", [*columns, "s"], lines)
    return rows


def reference() -> torch.Tensor:
    """The other method's `base_from_camera` (7,), of the optical frame."""
    body = np.load(XARM / "HT_base_cam.npy").astype(np.float64)
    turn, _, back = np.linalg.svd(body[:3, :3] @ OPTICAL.T)
    return poses.from_rotation_matrix(torch.from_numpy(body[:3, 3]), torch.from_numpy(turn @ back))


def camera() -> Camera:
    return Camera(
        "realsense",
        1280,
        720,
        908.30206,
        908.29272,
        642.96216,
        372.73154,
        poses.identity().numpy(),
        0.3,
        10.0,
    )


def seen(seeds: range, settings: dict[str, float], masked: bool) -> list[Row]:
    robot = Robot(XARM / "xarm7_plain.urdf")
    angles = [np.load(XARM / f"joint_state_{k}.npy") for k in range(5)]
    images = [1e-3 * np.asarray(Image.open(XARM / f"depth_{k}.png")).astype(np.float64) for k in range(5)]
    read = [np.asarray(Image.open(XARM / f"mask_{k}.png")) for k in range(5)]
    masks = read if masked else None
    truth, lines, errors, means = reference(), [], [], []
    for seed in seeds:
        tangent = torch.from_numpy(draw(seed, 0.05, math.radians(5.0)))
        guess = Guess(poses.retract(truth, -tangent).numpy(), np.full(3, 0.05), angle=math.radians(5.0))
        torch.manual_seed(seed)
        begun = time.perf_counter()
        scene = prepare(robot, camera(), prior_from_guess(guess), angles, images, masks, **settings)
        measured = images_of(scene, images, masks)
        proposal = fitted_proposal(scene, measured)
        population = importance_sampling(arm_in_view, (scene, len(angles)), measured, CAMERAS, proposal)
        seconds = time.perf_counter() - begun
        belief = population.belief("camera")
        off = poses.local(truth, belief.mean)
        spread = belief.spread
        error = [1e3 * float(off[:3].norm()), math.degrees(float(off[3:].norm()))]
        before = [1e3 * float(tangent[:3].norm()), math.degrees(float(tangent[3:].norm()))]
        wide = [1e3 * float(spread[:3].norm()), math.degrees(float(spread[3:].norm()))]
        bias, worth = 1e3 * float(mean(population, "bias")), population.effective_sample_size
        # How likely the reference is beside the likeliest particle, each with its own bias and rim.
        at_reference = population.trace.at({"camera": truth.expand(CAMERAS, 7)})
        gap = float(at_reference.log_prob().max() - population.trace.log_prob().max())
        lines.append([f"seed {seed}", *before, *error, *wide, gap, bias, worth, seconds])
        errors.append(error)
        means.append(1e3 * off[:3])
    kind = "with masks" if masked else "without masks"
    columns = ["", "guess mm", "deg", "mean mm", "deg", "spread mm", "deg", "gap nats", "bias mm", "ESS", "s"]
    show(f"xArm {kind}: the camera from {len(angles)} views, {CAMERAS} particles", columns, lines)
    millimetres, degrees = np.array(errors).T
    apart = max(float((one - other).norm()) for one in means for other in means)
    return [
        Row(f"xArm {kind}: camera off the reference, worst", float(millimetres.max()), "mm", 10.0),
        Row(f"xArm {kind}: camera off the reference, median", float(np.median(millimetres)), "mm"),
        Row(f"xArm {kind}: camera turned off the reference, worst", float(degrees.max()), "degrees", 1.0),
        Row(f"xArm {kind}: seeds apart, at most", apart, "mm"),
        Row(f"xArm {kind}: wall, median", float(np.median([line[-1] for line in lines])), "s"),
    ]


def by_nearest_points() -> list[Row]:
    """Where point-to-plane registration puts the camera, started at the reference."""
    robot, truth = Robot(XARM / "xarm7_plain.urdf"), reference()
    parts, clouds = [], []
    for k in range(5):
        parts.append(robot.as_part(np.load(XARM / f"joint_state_{k}.npy")).mesh)
        depth = 1e-3 * np.asarray(Image.open(XARM / f"depth_{k}.png")).astype(np.float64)
        shown = (np.asarray(Image.open(XARM / f"mask_{k}.png")) > 0) & (depth > 0.0)
        clouds.append((camera().rays() * depth.reshape(-1, 1))[shown.reshape(-1)])
    lines, rows = [], []
    for reach in (0.1, 0.03, 0.01):
        off = poses.local(truth, nearest_points(parts, clouds, truth, reach))
        error = [1e3 * float(off[:3].norm()), math.degrees(float(off[3:].norm()))]
        lines.append([f"within {1e3 * reach:g} mm", *error])
        rows.append(Row(f"xArm, nearest points within {1e3 * reach:g} mm: off the reference", error[0], "mm"))
    show("xArm by nearest points, started at the reference", ["", "off mm", "deg"], lines)
    return rows


def setting(text: str) -> tuple[str, float]:
    """A setting of the model, NAME=NUMBER."""
    name, _, value = text.partition("=")
    return name, int(value) if value.isdigit() else float(value)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--offsets", action="store_true", help="only offsets and the ball are latent")
    parser.add_argument("--only", choices=["ball", "xarm"], help="one of the two")
    parser.add_argument("--set", type=setting, nargs="*", default=[], help="NAME=NUMBER of arm_in_view")
    arguments = parser.parse_args()
    rows: list[Row] = []
    if arguments.only != "xarm":
        if BALL.is_dir():
            rows += calibration(arguments.quick, arguments.seed, arguments.offsets)
        else:
            print(f"skipped: the ball-in-socket recordings are not at {BALL}.")
    if arguments.only != "ball":
        if XARM.is_dir():
            seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else 5))
            rows += by_nearest_points()
            for masked in (False, True):
                rows += seen(seeds, dict(arguments.set), masked)
        else:
            print(f"skipped: the xArm's frames are not at {XARM}.")
    if rows:
        finish(rows, arguments.json)


if __name__ == "__main__":
    main()
