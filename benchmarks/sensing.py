"""From a wrench to where a peg was touched: how far off, and whether the stated uncertainty is true."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import shapely
import trimesh
from report import Row, finish, options, show
from scipy.stats import chi2

from bcppl.arrays import Array
from bcppl.contact.sensing.intrinsic import IntrinsicSensing
from bcppl.contact.sensing.location import ContactSensing
from bcppl.contact.sensing.noise import WrenchNoise, variance_gain
from bcppl.contact.sensing.surface_posterior import CORNER, EDGE, FACE
from bcppl.geometry.extrusion import box_peg, round_peg
from bcppl.geometry.parts import Part

LENGTH = 0.08  # m, from the sensor to the tip
FRICTION = (
    0.5  # the steepest cone: the world's forces are drawn from it, evenly, and it is what sensing assumes
)
NOISE = WrenchNoise(force=0.1, torque=0.005)
AVERAGED = 10  # samples: 0.1 s at 100 Hz
FORCES = ((3.0, 3.0), (5.0, 5.0), (8.0, 8.0), (15.0, 15.0), (3.0, 15.0))
KINDS = {FACE: "faces", EDGE: "edges", CORNER: "corners"}


def extruded(name: str, outline: shapely.Polygon) -> Part:
    """A peg of an outline, its frame that of `box_peg`."""
    mesh = trimesh.creation.extrude_polygon(outline, LENGTH)
    vertices = np.asarray(mesh.vertices) - np.array([0.0, 0.0, LENGTH])
    return Part(name, vertices, np.asarray(mesh.faces, dtype=np.int64))


def pegs() -> dict[str, Part]:
    """A box, a cylinder, a cylinder with a key, and a fork of two prongs, both of which a line may enter."""
    circle = shapely.Point(0.0, 0.0).buffer(0.007, quad_segs=16)
    keyed = shapely.union(circle, shapely.box(0.0, -0.002, 0.010, 0.002))
    fork = shapely.difference(
        shapely.box(-0.012, -0.008, 0.012, 0.008), shapely.box(-0.006, -0.004, 0.006, 0.009)
    )
    return {
        "box": box_peg(0.016, LENGTH),
        "cylinder": round_peg(0.008, LENGTH),
        "keyed": extruded("keyed peg", keyed),
        "fork": extruded("fork", fork),
    }


class Contacts(NamedTuple):
    """True contacts (M, ...): where, the normals there, what kind, which surface, which way the force."""

    point: Array
    normals: Array
    kind: npt.NDArray[np.int64]
    group: npt.NDArray[np.int64]
    direction: Array


def contacts(
    sensing: IntrinsicSensing, count: int, generator: np.random.Generator, friction: float
) -> Contacts:
    """Contacts all over a peg, as `IntrinsicSensing` supposes them, with forces evenly within the cone."""
    surface, edges = sensing.surface, sensing.surface.edges
    corner, around = surface.corners
    share = np.array(sensing.shares) * [1.0, len(edges.start) > 0, len(corner) > 0]
    kind = generator.choice(3, count, p=share / share.sum())
    seed = int(generator.integers(2**31))
    points, faces = trimesh.sample.sample_surface(surface.mesh, count, seed=seed)
    length = np.linalg.norm(edges.extent, axis=1)
    edge = generator.choice(len(length), count, p=length / length.sum())
    of = generator.integers(max(len(corner), 1), size=count)
    most = max(edges.normals.shape[1], around.shape[1] if len(corner) else 1)

    def padded(normals: Array) -> Array:
        return np.concatenate([normals, np.repeat(normals[:, :1], most - normals.shape[1], axis=1)], axis=1)

    point = np.where(
        (kind == FACE)[:, None],
        points,
        edges.start[edge] + generator.uniform(size=(count, 1)) * edges.extent[edge],
    )
    normals = np.where(
        (kind == FACE)[:, None, None], padded(surface.normals[faces][:, None]), padded(edges.normals[edge])
    )
    group = np.where(kind == FACE, surface.patch[faces], edges.chain[edge])
    if len(corner):
        there = kind == CORNER
        point[there], normals[there], group[there] = corner[of][there], padded(around[of])[there], of[there]
    direction, left = np.empty((count, 3)), np.arange(count)
    while len(left):
        drawn = generator.normal(size=(len(left), 3))
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        inside = np.einsum("qkx,qx->qk", -normals[left], drawn).max(axis=1) >= 1.0 / np.hypot(1.0, friction)
        direction[left[inside]] = drawn[inside]
        left = left[~inside]
    return Contacts(point, normals, kind, group, direction)


class Result(NamedTuple):
    """Errors in mm, shares in %."""

    median: float
    ninety: float
    any_median: float
    any_ninety: float
    half: float
    most: float
    ellipse: float
    candidates: float
    first: float
    among: float
    located: float
    found: float
    wall: float


COLUMNS = (
    "top mm",
    "90 % mm",
    "any mm",
    "90 % mm",
    "in 50 %",
    "in 90 %",
    "ellipse",
    "candidates",
    "first %",
    "among %",
    "one mm",
    "one %",
    "us each",
)


def measured(
    sensing: IntrinsicSensing,
    true: Contacts,
    force: tuple[float, float],
    share: float,
    generator: np.random.Generator,
) -> tuple[Result, Array]:
    """What is made of noisy wrenches of contacts, and the credible level (M,) of each true contact."""
    covariance = NOISE.covariance(share)
    pushed = generator.uniform(*force, (len(true.point), 1)) * true.direction
    wrench = np.concatenate([pushed, np.cross(true.point, pushed)], axis=1)
    wrench += generator.normal(size=wrench.shape) * np.sqrt(np.diag(covariance))
    begun = time.perf_counter()
    posterior = sensing.posterior(wrench, covariance)
    found = posterior.candidates()
    wall = time.perf_counter() - begun
    level = sensing.credible_level(posterior, wrench, covariance, true.point, true.normals)
    apart = found.location - true.point[:, None]
    error = np.nan_to_num(1e3 * np.linalg.norm(apart, axis=-1), nan=np.inf)
    same = (found.kind == true.kind[:, None]) & (found.group == true.group[:, None])
    # An ellipse in the surface: two degrees of freedom on a face, one along an edge, none at a corner.
    floor = 1e-10 * np.eye(3)
    spread = np.where(np.isfinite(found.covariance), found.covariance, 0.0) + floor
    step = np.nan_to_num(apart, nan=1.0)
    squared = np.sum(step * np.linalg.solve(spread, step[..., None])[..., 0], axis=-1)
    inside = squared <= np.array([chi2.ppf(0.9, 2), chi2.ppf(0.9, 1), 1.0])[found.kind]
    one = ContactSensing(sensing.peg, rate=100.0, friction=sensing.friction).locate(wrench)
    off = 1e3 * np.linalg.norm(one - true.point, axis=1)
    return Result(
        float(np.median(error[:, 0])),
        float(np.quantile(error[:, 0], 0.9)),
        float(np.median(error.min(axis=1))),
        float(np.quantile(error.min(axis=1), 0.9)),
        100.0 * float(np.mean(level < 0.5)),
        100.0 * float(np.mean(level < 0.9)),
        100.0 * float(np.mean((inside & (found.probability > 0)).any(axis=1))),
        float(found.count.mean()),
        100.0 * float(np.mean(same[:, 0])),
        100.0 * float(np.mean(same.any(axis=1))),
        float(np.nanmedian(off)),
        100.0 * float(np.mean(np.isfinite(off))),
        1e6 * wall / len(wrench),
    ), level


def main() -> None:
    arguments = options(__doc__ or "").parse_args()
    count = 300 if arguments.quick else 3000
    generator = np.random.default_rng(arguments.seed)
    lines: list[list[str | float]] = []
    every: list[tuple[Result, Array, Contacts]] = []
    for name, peg in pegs().items():
        sensing = IntrinsicSensing(peg, friction=FRICTION)
        for force in FORCES:
            true = contacts(sensing, count, generator, FRICTION)
            result, level = measured(sensing, true, force, 1.0 / AVERAGED, generator)
            label = f"{force[0]:g} N" if force[0] == force[1] else f"{force[0]:g} to {force[1]:g} N"
            lines.append([f"{name}, {label}", *result])
            if force[0] != force[1]:
                every.append((result, level, true))
    noise = f"{NOISE.force:g} N and {1e3 * NOISE.torque:g} mN m"
    show(f"{count} contacts a row, {noise} a sample, mean of {AVERAGED} samples", ["", *COLUMNS], lines)

    kinds = []
    for kind, label in KINDS.items():
        level = np.concatenate([at[true.kind == kind] for _, at, true in every])
        kinds.append([f"on {label}", len(level), *(100.0 * float(np.mean(level < p)) for p in (0.5, 0.9))])
    show("all pegs, 3 to 15 N: where the contact was", ["", "contacts", "in 50 %", "in 90 %"], kinds)

    box = box_peg(0.016, LENGTH)
    filtered = variance_gain(ContactSensing(box, rate=100.0).sections)
    others = []
    for label, share, assumed, friction, shares in (
        ("one sample", 1.0, FRICTION, FRICTION, (0.6, 0.3, 0.1)),
        ("20 Hz low-pass at 100 Hz", filtered, FRICTION, FRICTION, (0.6, 0.3, 0.1)),
        ("mean of 10, friction 1.0 assumed", 0.1, 1.0, FRICTION, (0.6, 0.3, 0.1)),
        ("mean of 10, friction 0.2", 0.1, FRICTION, 0.2, (0.6, 0.3, 0.1)),
        ("mean of 10, all on faces", 0.1, FRICTION, FRICTION, (1.0, 0.0, 0.0)),
        ("mean of 10, friction 1.0, and assumed so", 0.1, 1.0, 1.0, (0.6, 0.3, 0.1)),
    ):
        world = IntrinsicSensing(box, friction=friction, shares=shares)
        true = contacts(world, count, generator, friction)
        result, _ = measured(IntrinsicSensing(box, friction=assumed), true, (3.0, 15.0), share, generator)
        others.append([label, *result])
    show("box, 3 to 15 N: other settings", ["", *COLUMNS], others)

    def worst(field: str) -> float:
        return max(getattr(result, field) for result, _, _ in every)

    covered = [result.most for result, _, _ in every]
    finish(
        [
            Row("top candidate's error, median, worst peg", worst("median"), "mm", 0.5),
            Row("any candidate's error, median, worst peg", worst("any_median"), "mm"),
            Row("contacts in the 90 % region, fewest", min(covered), "%", 85.0, "min"),
            Row("contacts in the 90 % region, most", max(covered), "%", 95.0),
            Row("time of a wrench, worst peg", worst("wall"), "us"),
        ],
        arguments.json,
    )


if __name__ == "__main__":
    main()
