"""A log cut into probes, and these into windows."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bcppl.arrays import Array, Mask
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.fields import ArmFields, CutFields
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import Measurement

TARE = 10  # rows that a probe begins with in free air, as `ContactSensing` tares
LONGEST_HOLE = 0.25  # s without rows within a probe
SUSTAINED = 0.02  # s of force that make a touch: an impact of the tool's motion is shorter
PRESSED = 1.0  # N from the log's zero: a probe that begins so may begin in contact
FORGOTTEN = 2.0  # s over which the zero of free motion follows a sensor that drifts


@dataclass(frozen=True, eq=False)
class Rows:
    """A log at common stamps.

    Attributes:
        stamps: (T,) s.
        wrench: (T, 6) on the peg, in its frame about its origin, without the tool's weight.
        world_from_peg: (T, 7) as measured.
        known: (T,) whether both streams have data there.
    """

    stamps: Array
    wrench: Array
    world_from_peg: Array
    known: Mask


@dataclass(frozen=True, eq=False)
class Command:
    """Times (C,) and poses (C, 7), `world_from_peg`, that the arm was commanded."""

    times: Array
    world_from_peg: Array


def probes(
    rows: Rows, fields: CutFields, arm: ArmFields, command: Command | None, report: list[str]
) -> list[Measurement]:
    """The windows of all probes of a log.

    Raises:
        InputError: a span is empty or outside the log, a probe has a long hole or begins in contact, or no
            touch was found.
    """
    measurements: list[Measurement] = []
    spans = _spans(rows, fields, report)
    for number, (begin, end) in enumerate(spans, 1):
        name = "touches" if len(spans) == 1 else f"touches {number}"
        inside = (rows.stamps >= begin - 1e-9) & (rows.stamps <= end + 1e-9)
        if not (inside & rows.known).sum() > TARE:
            raise InputError(
                f"the span {begin:.2f} to {end:.2f} s holds {int((inside & rows.known).sum())} rows; the log "
                f"lasts from {rows.stamps[0]:.2f} to {rows.stamps[-1]:.2f} s: give longer spans in it."
            )
        _refuse_hole(rows.stamps[inside], rows.known[inside], name)
        kept = inside & rows.known
        if lost := int(inside.sum() - kept.sum()):
            report.append(
                f"{name}: {lost} of {int(inside.sum())} stamps are left out, for a stream lacks rows"
            )
        first = rows.wrench[kept][:TARE, :3].mean(axis=0)
        if (away := float(np.linalg.norm(first - rows.wrench[rows.known][:TARE, :3].mean(axis=0)))) > PRESSED:
            report.append(
                f"{name}: begins {away:.1f} N from the log's first rows; unless the sensor's zero drifted "
                "so far, begin the span earlier, in free air"
            )
        measurements += _windows(name, rows, kept, fields.window, arm, command)
    return measurements


def _windows(
    name: str, rows: Rows, kept: Mask, length: float, arm: ArmFields, command: Command | None
) -> list[Measurement]:
    stamps, measured, wrench = rows.stamps[kept], rows.world_from_peg[kept], rows.wrench[kept]
    times, led = stamps, measured  # the measured pose stands for a command that is not known
    if command is not None:
        near = (command.times >= stamps[0] - 0.5) & (command.times <= stamps[-1] + 0.5)
        if not near.any():
            raise InputError(f"{name} has no command; give the command's log of the same time, or none.")
        times, led = command.times[near], command.world_from_peg[near]
    probe = Probe(name, times, led, np.array(arm.stiffness), np.array(arm.damping), stamps)
    number = np.floor((stamps - stamps[0]) / length + 1e-6)
    ends = [0, *(np.flatnonzero(np.diff(number) > 0) + 1).tolist(), len(stamps)]
    return [
        Measurement(
            ProbeWindow(probe, first, last),
            Touch(stamps[first:last], wrench[first:last], measured[first:last]),
        )
        for first, last in itertools.pairwise(ends)
    ]


def _refuse_hole(stamps: Array, known: Mask, name: str) -> None:
    """Refuse a stretch without rows that is too long for its contacts to be one motion."""
    there = stamps[known]
    steps = np.diff(np.concatenate([stamps[:1], there, stamps[-1:]]))
    if len(steps) and steps.max() > LONGEST_HOLE:
        at = int(steps.argmax())
        begin = stamps[0] if at == 0 else there[at - 1]
        raise InputError(
            f"{name} lacks data from {begin:.2f} to {begin + steps[at]:.2f} s; state cut.spans without that "
            "stretch, or cut.gap if it may be interpolated."
        )


def _spans(rows: Rows, fields: CutFields, report: list[str]) -> list[tuple[float, float]]:
    first, last = float(rows.stamps[0]), float(rows.stamps[-1])
    if fields.spans:
        spans = [(float(begin), float(end)) for begin, end in fields.spans]
        for k, (begin, end) in enumerate(spans):
            if not first - 1e-9 <= begin < end <= last + 0.01:
                raise InputError(
                    f"cut.spans[{k}] is {begin:g} to {end:g} s; give spans within the log, {first:.2f} to "
                    f"{last:.2f} s, each with its begin before its end."
                )
        for (_, end), (begin, _) in itertools.pairwise(sorted(spans)):
            if begin < end:
                raise InputError(
                    f"cut.spans has one that begins at {begin:g} s, before another ends at {end:g} s; rows "
                    "in both would count twice."
                )
        return spans
    if fields.find == "whole":
        known = rows.stamps[rows.known]
        if not len(known):
            raise InputError("wrench and pose have no rows at the same times; see their stamps and gaps.")
        return [(float(known[0]), float(known[-1]))]
    spans = list(_touches(rows, fields))
    if not spans:
        raise InputError(
            f"no force of {fields.force:g} N was found in the log; give a lower cut.force, or "
            "cut.find: whole."
        )
    report.append(f"cut: {len(spans)} stretches with touches of {fields.force:g} N and more")
    return spans


def _pressed(force: Array, threshold: float, share: float) -> Mask:
    """Whether forces (T, 3) exceed a threshold (N) from a zero that follows those that do not."""
    zero = force[:TARE].mean(axis=0)
    pressed = np.zeros(len(force), dtype=bool)
    for k, each in enumerate(force):
        away = each - zero
        pressed[k] = away @ away > threshold**2
        if not pressed[k]:
            zero = zero + share * away
    return pressed


def _touches(rows: Rows, fields: CutFields) -> Iterator[tuple[float, float]]:
    """From `before` each touch until `after` it; touches between which no free stretch fits are one."""
    stamps, wrench = rows.stamps[rows.known], rows.wrench[rows.known]
    step = float(np.median(np.diff(stamps)))
    pressed = _pressed(wrench[:, :3], fields.force, step / FORGOTTEN)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], pressed, [False]])))
    begin = end = None
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if (last - first) * step < SUSTAINED:
            continue
        onset, release = float(stamps[first]), float(stamps[last - 1])
        if end is not None and begin is not None and onset - fields.before <= end + fields.after:
            end = release
            continue
        if begin is not None and end is not None:
            yield begin, min(end + fields.after, float(stamps[-1]))
        begin, end = max(onset - fields.before, float(stamps[0])), release
    if begin is not None and end is not None:
        yield begin, min(end + fields.after, float(stamps[-1]))
