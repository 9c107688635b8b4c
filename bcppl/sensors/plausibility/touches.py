"""Doubts about probes: the mistake under whose repair contacts are at the part and forces fit it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array, Mask
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.parts import Guess, Part
from bcppl.sensors import checks
from bcppl.sensors.measurements import Measurement
from bcppl.sensors.plausibility.contacts import Contacts, Felt, Met, along_axis, felt_by
from bcppl.sensors.plausibility.images import reordered
from bcppl.sensors.plausibility.pegs import peg_doubt
from bcppl.sensors.plausibility.search import Found, is_narrow
from bcppl.sensors.plausibility.torques import torque_doubt
from bcppl.sensors.plausibility.units import FEWEST, command_doubt, in_newtons, jump_doubt, zero_doubt
from bcppl.sensors.plausibility.wording import of_probes

TOUCHING = 0.004  # m: gaps up to which a felt contact is one with the part
# Of 60 right scenes of the bench, with a real one's errors and without: shares of 0.82 to 0.97, mean cosines
# of 0.90 to 0.99, and no clock that is off explains more of the stamps.
DOUBTED, MORE = 1.65, 0.25  # a quality below which other poses of the peg are tried, and their least gain
FAR = 0.3  # a share below which contacts are not with the part
CLEARLY = 0.4  # by which a repair has to raise the sum of share and cosine
TURNED, LEAST_TURN, FITS = (
    0.08,
    math.radians(25.0),
    1.72,
)  # of a turn: its gain, its size, and the sum with it
ASKEW = 0.4  # a mean cosine of force and normal below which the force's axes are wrong
ALONG = np.arange(-0.35, 0.3501, 0.005)  # m along the peg's axis
SHIFTED = 0.02  # m: a shorter shift is as well the part's place
# A peg whose sides touch is as near anywhere along them: of three minima the right one was not.
SHIFTS = 6
CLOCK = (-0.4, -0.3, -0.2, 0.2, 0.3, 0.4)  # s by which the wrench is late
LATER = 0.03  # of the stamps that a clock has to explain more
GAPS = (0.001, 0.002, 0.004, 0.006)  # m: limits between contact and none


@dataclass(frozen=True)
class Hypothesis:
    """What probes would be without a mistake, and the mistake in words.

    It has to raise the quality by `least`, to `fits` or more.
    """

    words: str
    probes: Sequence[Felt]
    least: float = CLEARLY
    fits: float = 0.0


@dataclass(frozen=True)
class Judged:
    """How well a hypothesis explains contacts: `quality` is up to 2."""

    hypothesis: Hypothesis
    met: Met
    cosine: float

    @property
    def quality(self) -> float:
        """The share of the contacts' score, and the mean cosine of force and normal."""
        return self.met.share + self.cosine


def touch_doubts(
    measurements: Sequence[Measurement], part: Part, peg: Part | None, guess: Guess, start: Found | None
) -> list[str]:
    """Doubts about probes, the part being near `start` where that is known."""
    if peg is None or list(checks.part(peg, closed=True)) or list(checks.part(part, closed=True)):
        return []
    probes = felt_by([m for m in measurements if _is_readable(m)])
    by_cause: dict[str, list[str]] = {}
    touching = []
    for felt in probes:
        in_units, causes = in_newtons(felt, peg)
        # By a wrench that is tared in contact, where the peg is free it seems to touch; a peg that jumps is
        # nowhere.
        astray = [*zero_doubt(in_units), *jump_doubt(felt)]
        for cause in [*causes, *astray, *command_doubt(felt)]:
            by_cause.setdefault(cause, []).append(felt.probe.name)
        if not astray and in_units.contact.sum() >= FEWEST:
            touching.append(in_units)
    lines = [*peg_doubt(peg), *(f"{of_probes(names)} has {cause}." for cause, names in by_cause.items())]
    if touching and is_narrow(guess):
        try:
            lines += _of_contacts(Contacts(part, peg, guess), touching, start)
        except InputError:  # of a mesh that has a problem, which a check of the recording names
            return lines
    return lines


def _is_readable(measurement: Measurement) -> bool:
    touch = measurement.observation
    if not isinstance(touch, Touch) or np.size(touch.world_from_peg) == 0:
        return False
    return not (
        list(checks.times("", touch.times))
        or list(checks.rows("", touch.wrench, touch.times, "fx fy fz mx my mz"))
        or list(checks.poses("", touch.world_from_peg, touch.times))
    )


def _of_contacts(contacts: Contacts, probes: Sequence[Felt], start: Found | None) -> Iterator[str]:
    stated = judged(contacts, Hypothesis("", probes), start)
    best = stated
    for hypothesis in _hypotheses(contacts, stated, start):
        other = judged(contacts, hypothesis, start)
        needed = max(stated.quality + hypothesis.least, best.quality + 0.05, hypothesis.fits)
        if other.quality > needed:
            best = other
    who = of_probes([felt.probe.name for felt in probes])
    if best.hypothesis.words:
        yield f"{who}: {best.hypothesis.words}."
    if best.met.share < FAR:
        contact = np.concatenate([felt.contact for felt in probes])
        off = 1e3 * float(np.median(np.abs(best.met.gap[contact])))
        yield (
            f"{who}: contact is felt with the peg {off:.0f} mm from the part, wherever that is within the "
            "guess: probably the peg's pose or the guess is of another frame, or something else is touched."
        )
        return
    if best.cosine < ASKEW:
        yield (
            f"{who}: the forces do not point out of the part (the mean cosine to its normal is "
            f"{best.cosine:.2f}): probably the wrench is not in the peg's frame; turn it there."
        )
        return
    near = _near(probes, best.met)
    if best is stated and near.sum() >= FEWEST:
        wrench = np.concatenate([felt.wrench for felt in probes])
        yield from (f"{who} has {words}." for words in torque_doubt(wrench[near], best.met.place[near]))
    if start is not None:  # touches alone leave room for a part that suits another clock
        yield from _clock(contacts, best, who, start)


def judged(contacts: Contacts, hypothesis: Hypothesis, start: Found | None) -> Judged:
    """A hypothesis at the pose at which its contacts fit best."""
    met = contacts.fit(hypothesis.probes, start)
    return Judged(hypothesis, met, _cosine(hypothesis.probes, met))


def _cosine(probes: Sequence[Felt], met: Met) -> float:
    """The mean cosine of the force and the part's normal, of contacts at the part; 0 where there are none."""
    force, near = np.concatenate([felt.force for felt in probes]), _near(probes, met)
    if near.sum() < FEWEST:
        return 0.0
    size = np.linalg.norm(force[near], axis=1)
    return float(np.mean((force[near] * met.normal[near]).sum(axis=1) / size))


def _near(probes: Sequence[Felt], met: Met) -> Mask:
    """Whether (T,) a contact is at the part."""
    contact = np.concatenate([felt.contact for felt in probes])
    return np.asarray(contact & (np.abs(met.gap) < TOUCHING))


def _hypotheses(contacts: Contacts, stated: Judged, start: Found | None) -> Iterator[Hypothesis]:
    """What may be wrong, the simplest first; only that which what is stated leaves room for."""
    probes = stated.hypothesis.probes

    def each(changed: Callable[[Felt], Felt]) -> list[Felt]:
        return [changed(felt) for felt in probes]

    if stated.quality + TURNED > 2.0:
        return
    if stated.quality + CLEARLY < 2.0:
        yield Hypothesis(
            "forces point into the part: probably the sign, take -wrench, which the part exerts on the peg",
            each(lambda felt: replace(felt, wrench=-felt.wrench)),
        )
        yield Hypothesis(
            "contacts fit the part if the quaternion in world_from_peg is written x y z w: put its last "
            "number first",
            each(lambda felt: replace(felt, pose=reordered(felt.pose))),
        )
    if stated.quality < DOUBTED:
        yield Hypothesis(
            "contacts fit the part if world_from_peg is inverted, peg_from_world: give the inverse",
            each(lambda felt: replace(felt, pose=poses.inverse(torch.from_numpy(felt.pose)).numpy())),
            MORE,
        )
        for metres in _shifts(contacts, probes, start):
            yield Hypothesis(
                f"contacts fit the part if the peg is {1e3 * abs(metres):.0f} mm farther along its axis, "
                f"{_side(metres)}: probably world_from_peg is of the flange or of another tool frame, "
                "compose it with flange_from_peg",
                each(lambda felt, metres=metres: along_axis(felt, metres)),  # type: ignore[misc]
                MORE,
            )
    if start is None:
        return
    angle = _turn(probes, stated.met)
    if abs(angle) >= LEAST_TURN:
        yield Hypothesis(
            f"forces fit the part if they are turned by about {math.degrees(angle):.0f}° about the peg's "
            "axis: probably its yaw in the hand was left out of world_from_peg or of the wrench's frame",
            each(lambda felt: replace(felt, wrench=_about_z(felt.wrench, angle))),
            TURNED,
            FITS,
        )


def _side(metres: float) -> str:
    return "towards its tip" if metres < 0.0 else "away from its tip"


def _shifts(contacts: Contacts, probes: Sequence[Felt], start: Found | None) -> list[float]:
    """The shifts along the peg's axis, at most `SHIFTS`, at which contacts are nearest to the part."""
    costs = np.array([contacts.distance(probes, start, float(metres)) for metres in ALONG])
    inner = (costs[1:-1] <= costs[:-2]) & (costs[1:-1] <= costs[2:])
    minima = np.flatnonzero(inner) + 1
    few = minima[np.argsort(costs[minima])][:SHIFTS]
    return [float(ALONG[k]) for k in few if abs(ALONG[k]) >= SHIFTED]


def _about_z(wrench: Array, angle: float) -> Array:
    turn = np.array(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    return np.hstack([wrench[:, :3] @ turn.T, wrench[:, 3:] @ turn.T])


def _turn(probes: Sequence[Felt], met: Met) -> float:
    """The turn of wrenches about the peg's axis under which forces point out of the part best, radians."""
    angles = np.radians(np.arange(-180.0, 180.0, 15.0))
    cosines = [
        _cosine([replace(felt, wrench=_about_z(felt.wrench, float(angle))) for felt in probes], met)
        for angle in angles
    ]
    return float(angles[int(np.argmax(cosines))])


def _clock(contacts: Contacts, stated: Judged, who: str, start: Found | None) -> Iterator[str]:
    """The doubt where contacts fit clearly better with the wrench earlier or later."""
    probes = stated.hypothesis.probes
    unexplained = _unexplained(probes, stated.met)
    if unexplained < LATER:
        return
    found = {}
    for seconds in CLOCK:
        moved = [_earlier(felt, seconds) for felt in probes]
        found[seconds] = _unexplained(moved, contacts.fit(moved, start))
    best = min(found, key=found.__getitem__)
    if unexplained - found[best] > LATER:
        way = "late" if best > 0.0 else "early"
        yield (
            f"{who}: contact is felt where the peg is free, but hardly if the wrench is about {abs(best):g} "
            f"s {way}: give the wrench and the peg's pose on one clock."
        )


def _earlier(felt: Felt, seconds: float) -> Felt:
    middles = 0.5 * (felt.times[1:] + felt.times[:-1])
    return replace(felt, wrench=felt.wrench[np.searchsorted(middles, felt.times + seconds)])


def _unexplained(probes: Sequence[Felt], met: Met) -> float:
    """The share of the stamps with contact away from the part, or without at it."""
    contact = np.concatenate([felt.contact for felt in probes])
    return min(float(np.mean(np.where(contact, met.gap > gap, met.gap < gap))) for gap in GAPS)
