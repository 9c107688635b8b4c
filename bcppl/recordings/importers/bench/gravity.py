"""The tool's weight in a log of touches: identified from the stretches without contact, and subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array, Indices, Mask
from bcppl.contact.sensing import ToolLoad, identify_load
from bcppl.contact.sensing.load import STANDARD_GRAVITY, gravity_in, tilts_enough
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import GravityFields

BLOCK = 0.02  # s: readings are means over blocks; in longer ones a tool turns too far
FEWEST = 12  # blocks without contact
DRAWS, SEED = 400, 0  # of blocks that a load is fitted to
TOLERANCE = 0.5  # N, and N m times a lever of 0.1 m: a block further from the weight is in contact
FREE = 0.3  # of the blocks at least are without contact


@dataclass(frozen=True)
class Weight:
    """What was subtracted.

    Attributes:
        load: mass and centre in the peg's frame; None where nothing was subtracted.
        words: for the report.
    """

    load: ToolLoad | None
    words: str


def without_weight(
    wrench: Array,
    world_from_peg: Array,
    stamps: Array,
    fields: GravityFields,
    peg_from_sensor: Array,
) -> tuple[Array, str]:
    """Wrenches (T, 6) without the tool's weight, in the peg's frame about its origin, and what was done.

    The sensor's zero stays in them: it drifts, and each probe is tared by its own first rows.

    Args:
        wrench: (T, 6) raw.
        world_from_peg: (T, 7), in a world whose z axis points up.
        stamps: (T,) s.
        fields: what is stated of the load.
        peg_from_sensor: (7,), for a centre that is stated in the sensor's frame.

    Raises:
        InputError: the stated mass or centre is out of range.
    """
    weight = _weight(wrench, world_from_peg, stamps, fields, peg_from_sensor)
    words = f"gravity: {weight.words}"
    return (wrench, words) if weight.load is None else (wrench - weight.load.weight(world_from_peg), words)


def _weight(
    wrench: Array, world_from_peg: Array, stamps: Array, fields: GravityFields, peg_from_sensor: Array
) -> Weight:
    if fields.load == "compensated":
        return Weight(None, "compensated by the controller, as stated")
    if fields.load == "stated":
        assert fields.mass is not None and fields.center is not None
        center = factor(fields.length) * np.array(fields.center)
        turn = Rotation.from_quat(peg_from_sensor[[4, 5, 6, 3]])
        x, y, z = (turn.apply(center) + peg_from_sensor[:3]).tolist()
        return Weight(ToolLoad(fields.mass, (x, y, z)), f"the stated {fields.mass:g} kg subtracted")
    readings, poses = _blocks(wrench, world_from_peg, stamps)
    turned = _turned(poses)
    if not tilts_enough(gravity_in(poses)):
        return Weight(
            None,
            f"the tool's tilt varies by {np.degrees(turned):.1f} degrees, too little to identify its "
            "mass and centre; the weight stays in the zero that each probe is tared by"
            + (_advice(turned) if turned > np.radians(1.0) else ""),
        )
    free = _without_contact(readings, poses)
    try:
        if free.sum() < FEWEST or free.mean() < FREE:
            raise InputError(f"{int(free.sum())} of {len(free)} blocks of {BLOCK:g} s agree on a load")
        estimate = identify_load(readings[free], poses[free])
    except InputError as error:
        return Weight(None, f"not identified ({str(error).rstrip('.')}); nothing subtracted{_advice(turned)}")
    load, spread = estimate.load, estimate.standard_deviation
    x, y, z = (1000.0 * c for c in load.center)
    zero = np.linalg.norm(estimate.bias[:3])
    return Weight(
        load,
        f"{load.mass:.3f} ± {spread[0]:.3f} kg at ({x:.1f}, {y:.1f}, {z:.1f}) ± "
        f"{1000 * spread[1:4].max():.1f} mm in the peg's frame, a zero of {zero:.2f} N, identified from "
        f"{int(free.sum())} blocks of {BLOCK:g} s without contact, and its weight subtracted",
    )


def _advice(turned: float) -> str:
    least = np.linalg.norm(STANDARD_GRAVITY) * np.sin(0.5 * turned)
    return (
        f": a tool of 1 kg then reads up to {least:.1f} N that no contact exerts; state gravity.mass and "
        "gravity.center, or log the tool in free air, tilted about two axes by 30 degrees"
    )


def _blocks(wrench: Array, world_from_peg: Array, stamps: Array) -> tuple[Array, Array]:
    """Means of the wrench (B, 6), and the middle poses (B, 7), of blocks in which the tool hardly turns."""
    number = np.floor((stamps - stamps[0]) / BLOCK).astype(np.int64)
    begins = np.flatnonzero(np.append(True, np.diff(number) > 0))
    counts = np.diff(np.append(begins, len(stamps)))
    sums = np.add.reduceat(wrench, begins, axis=0)
    return sums / counts[:, None], world_from_peg[begins + counts // 2]


def _turned(poses: Array) -> float:
    """The largest angle (rad) between directions of gravity at poses (B, 7), in their frames."""
    pulls = gravity_in(poses) / np.linalg.norm(STANDARD_GRAVITY)
    cosine = np.clip(pulls[:: max(1, len(pulls) // 500)] @ pulls.T, -1.0, 1.0)
    return float(np.arccos(cosine.min()))


def _without_contact(readings: Array, poses: Array) -> Mask:
    """Blocks (B,) without contact: the largest set that one load and zero explain, with the first of them.

    Contacts differ from each other, and a log begins in free air. Loads are fitted to few blocks drawn at
    random (RANSAC, Fischler and Bolles 1981); the best one is fitted again to what agrees with it.
    """
    pulls, generator = gravity_in(poses), np.random.default_rng(SEED)
    best = np.zeros(len(pulls), dtype=bool)
    for _ in range(DRAWS):
        drawn = np.append(0, generator.choice(len(pulls), 3, replace=False))
        agrees = _agrees(readings, pulls, drawn)
        if agrees.sum() > best.sum():
            best = agrees
    for _ in range(5):
        again = _agrees(readings, pulls, np.flatnonzero(best)) if best.any() else best
        if (again == best).all():
            break
        best = again
    return best


def _agrees(readings: Array, pulls: Array, chosen: Indices) -> Mask:
    """Whether forces (B,) agree with the load and zero of some blocks."""
    mean_pull, mean = pulls[chosen].mean(axis=0), readings[chosen, :3].mean(axis=0)
    away, felt = pulls[chosen] - mean_pull, readings[chosen, :3] - mean
    power = float((away**2).sum())
    mass = float((away * felt).sum()) / power if power > 1e-6 else 0.0
    residual = readings[:, :3] - mean - mass * (pulls - mean_pull)
    return np.asarray(np.linalg.norm(residual, axis=1) < TOLERANCE)
