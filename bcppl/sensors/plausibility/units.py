"""Doubts about a probe's own numbers, without the part: units of wrenches, their zero, and the command."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bcppl.geometry.parts import Part
from bcppl.sensors.plausibility.contacts import LEAST, ZERO, Felt

FAINTEST, STRONGEST = 0.3, 1000.0  # N: the largest force of a probe that meets something is between
CLEAR = 20.0  # times the noise: a contact, whatever the unit
LONGEST, SHORTEST = 10.0, 0.002  # reaches of the peg: the median lever of its contacts is between
FASTEST = 3.0  # m/s of a peg that an arm moves
STILL, MOVED = 0.001, 0.005  # m: a command that stands still, a peg that moves
LEFT = 0.005  # m from where it began: the peg has left, and retreats over as much again
STEADY = 0.3  # of a force: by so much it may vary
WEAK = 0.3  # of the force of a zero, and
OFTEN = 0.1  # of the stamps that have as little, of a peg that moves: there it is free
AGAINST = 0.7  # the least cosine between a retreat and the force that it seems to overcome
FEWEST = 10  # stamps in contact, below which they decide nothing


def force_unit(felt: Felt) -> tuple[float, str]:
    """The factor to newtons, and the mistake in words: 1 and "" for newtons."""
    largest = float(np.quantile(felt.size, 0.98))
    noise = float(np.linalg.norm(felt.noise[:3]))
    if largest > STRONGEST:
        return 1e-3, (
            f"forces of {largest:.3g} N, which few arms bear: probably millinewtons, scale them by 0.001"
        )
    if 0.0 < CLEAR * noise < largest < FAINTEST:
        return 1e3, (
            f"forces of at most {largest:.2g} N, but clear contacts: probably kilonewtons, scale them by 1000"
        )
    return 1.0, ""


def torque_unit(felt: Felt, peg: Part) -> tuple[float, str]:
    """The factor to newton metres, of a probe with forces in newtons, and the mistake in words."""
    contact = felt.contact
    if contact.sum() < FEWEST:
        return 1.0, ""
    torque = np.linalg.norm(felt.wrench[contact, 3:], axis=1)
    lever = float(np.median(torque / felt.size[contact]))
    reach = float(np.linalg.norm(peg.vertices, axis=1).max())
    where = f"forces that act {lever:.3g} m from the origin of a peg that ends {reach:.3g} m from it"
    if lever > LONGEST * reach:
        return 1e-3, f"{where}: probably the torques are in N mm, scale them by 0.001"
    if 0.0 < lever < SHORTEST * reach:
        return 1e3, f"{where}: probably the torques are in kN m, scale them by 1000"
    return 1.0, ""


def in_newtons(felt: Felt, peg: Part) -> tuple[Felt, list[str]]:
    """The probe in newtons and newton metres, and the mistakes in words."""
    force, first = force_unit(felt)
    scaled = felt.scaled(force, 1.0)
    torque, second = torque_unit(scaled, peg)
    if first and torque == force:
        first, second = f"{first}, and torques too", ""
    return scaled.scaled(1.0, torque), [words for words in (first, second) if words]


def zero_doubt(felt: Felt) -> Iterator[str]:
    """The mistake in words where a probe begins in contact, so that its wrench is tared by a contact.

    Then that contact's force, reversed, is felt from when the peg leaves the surface, against it, until the
    end. A surface that is met later is not felt as early, and one that is slid on does not oppose the motion.
    Of a sensor that is tared, or relieved of the tool's weight, the zero alone tells: it is a force where
    there is hardly one elsewhere.
    """
    taken = float(np.linalg.norm(felt.zero[:3]))
    weak = np.linalg.norm((felt.wrench + felt.zero)[:, :3], axis=1) < WEAK * taken
    moves = float(np.ptp(felt.pose[weak, :3], axis=0).max()) if weak.any() else 0.0
    if taken > 2.0 * LEAST and weak.mean() > OFTEN and moves > 2.0 * LEFT:
        yield (
            f"a force of {taken:.1f} N in its first rows, which are taken for the sensor's zero, and hardly "
            f"any in {100.0 * weak.mean():.0f} % of the others: probably it begins in contact; record from "
            "before that"
        )
        return
    away = np.linalg.norm(felt.pose[:, :3] - felt.pose[0, :3], axis=1)
    if away.max() < 2.0 * LEFT:
        return
    leaving = slice(int((away > LEFT).argmax()), int((away >= 2.0 * LEFT).argmax()) + 1)
    force = felt.force
    stays = force[-ZERO:].mean(axis=0)
    size = float(np.linalg.norm(stays))
    off = np.linalg.norm(np.concatenate([force[leaving], force[-ZERO:]]) - stays, axis=1)
    retreat = felt.pose[leaving.stop - 1, :3] - felt.pose[leaving.start, :3]
    against = -float(retreat @ stays) > AGAINST * size * float(np.linalg.norm(retreat))
    if against and size > LEAST and np.quantile(off, 0.9) < STEADY * size:
        yield (
            f"a force of {size:.1f} N that stays when the peg has left where it began: probably it begins in "
            "contact, and the mean of its first rows is no zero of the sensor; record from before the contact"
        )


def command_doubt(felt: Felt) -> Iterator[str]:
    """The mistake in words where a command stands still while the peg moves.

    Where nothing pulls the peg towards it, no command is known.
    """
    if not np.any(felt.probe.stiffness):
        return
    command = np.asarray(felt.probe.command, dtype=float)
    if command.ndim != 2 or command.shape[1:] != (7,):
        return
    moved = float(np.ptp(felt.pose[:, :3], axis=0).max())
    if len(command) == 0 or (float(np.ptp(command[:, :3], axis=0).max()) < STILL and moved > MOVED):
        yield (
            f"a command that never changes, while the peg moves by {1e3 * moved:.0f} mm: give the commanded "
            "poses, or the measured ones where the controller states none"
        )


def jump_doubt(felt: Felt) -> Iterator[str]:
    """The mistake in words where the peg is measured to move faster than an arm does."""
    steps = np.linalg.norm(np.diff(felt.pose[:, :3], axis=0), axis=1)
    seconds = np.diff(felt.times)
    jumps = steps > FASTEST * seconds
    if jumps.any():
        farthest = int(np.where(jumps, steps, 0.0).argmax())
        yield (
            f"a peg that jumps {int(jumps.sum())} times, by {1e3 * steps[farthest]:.0f} mm within "
            f"{1e3 * seconds[farthest]:.0f} ms: probably two sources of one pose, or stamps that are wrong"
        )
