"""Doubts about torques, where forces fit the part: their sign, and the point that they are about."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bcppl.arrays import Array

# In right scenes of the bench the correlation is nearly 1, and the point within 15 mm of the peg's origin.
OPPOSED = 0.5  # correlation of torques with those of the forces, reversed
MOVED = 0.03  # m: another point of the torques; a side that touches is as near anywhere along it
EXPLAINED = 0.1  # of the square of what differs: at most so much is left about that point
LEVER = 0.005  # m: shorter ones tell nothing


def torque_doubt(wrench: Array, place: Array) -> Iterator[str]:
    """The mistake in words, of wrenches (T, 6) of contacts at places (T, 3), both in the peg's frame.

    A single contact's torque is place x force. With torques of the wrong sign the correlation is negative;
    about a point d they are (place - d) x force.
    """
    force, torque = wrench[:, :3], wrench[:, 3:]
    expected = np.cross(place, force)
    size = np.linalg.norm(force, axis=1)
    if np.median(np.linalg.norm(expected, axis=1) / size) < LEVER:
        return
    if not torque.any():
        yield (
            "torques that are all zero, while forces act beside the peg's origin: probably the sensor's were "
            "left out, and a model that locates contacts by them is misled; give them"
        )
        return
    agreement = (torque * expected).sum() / np.sqrt((torque**2).sum() * (expected**2).sum())
    if agreement < -OPPOSED:
        yield "torques opposite to those of the forces where the peg meets the part: take -torque"
        return
    # expected - torque = d x force, in d (3,)
    missing = (expected - torque).ravel()
    across = np.stack([np.cross(axis, force) for axis in np.eye(3)], axis=2).reshape(-1, 3)
    off, *_ = np.linalg.lstsq(across, missing, rcond=None)
    left = ((missing - across @ off) ** 2).sum() / (missing**2).sum()
    if np.linalg.norm(off) > MOVED and left < EXPLAINED:
        where = ", ".join(f"{1e3 * each:.0f}" for each in off)
        yield (
            f"torques that fit the forces about the point ({where}) mm of the peg's frame: probably they are "
            "about the sensor's origin; give them about the peg's"
        )
