"""What would explain touches that do not fit: each hypothesis by its evidence.

    from bcppl.inference.criticism import explanations

    for each in explanations(model, recording):
        print(f"{each.hypothesis}: {each.gain:.0f} nats")

A wrench that is read late, a peg that is turned in the hand, a part that moved: each is a recording as it
would be otherwise (`bcppl.sensors.altered`), and the touches have an evidence under it, the pose and all
that is shared integrated out in the Gaussian approximation about the posterior's modes. That of a
hypothesis with several values, a clock that is off by 0.1 or by 0.2 s, is the mean over them: to try many
costs the logarithm of how many (Occam's factor).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.manifold import FARTHEST
from bcppl.geometry.turns import turns_freely
from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.criticism.hypotheses import VERY_STRONG
from bcppl.recordings import Recording
from bcppl.sensors.altered import (
    with_peg_along,
    with_peg_thicker,
    with_peg_turned,
    with_wrench_earlier,
    with_wrench_reversed,
)
from bcppl.sensors.capabilities import Approximated, Defers, FeelsForces, FitsPose
from bcppl.traces import Model

CLOCK = (0.05, 0.1, 0.2, 0.4)  # s, early or late
# nats: the evidence for an error of the clock has to be above this. With another clock other rows are in
# contact: for that alone it was up to 19 in 32 good recordings, and 75 to 145 in 32 with clocks 0.05 to 0.2 s
# off.
OTHER_ROWS = 40.0
TURN = (9.0, 18.0, 27.0, 36.0, 45.0)  # degrees, either way
THICKNESS = (0.00025, 0.0005, 0.001)  # m, thicker or thinner
ALONG, STEP = 0.3, 0.002  # m: how far off the peg's pose may be along its axis, and a step of the search
OFF = 0.003  # m from which on that is worth a hypothesis
FAR, FEW, MINIMA = 0.02, 2, 3  # m beyond which a row does not decide that; every so many rows; minima
OUTWARDS = 0.98  # the probability that the mean force of a contact points out of the part


class Explanation(NamedTuple):
    """A hypothesis under which touches are more probable.

    Attributes:
        hypothesis: such as "the wrench is read 0.2 s late".
        gain: its log Bayes factor to the recording as it is stated, nats.
    """

    hypothesis: str
    gain: float


def explanations(model: Model, recording: Recording) -> list[Explanation]:
    """The hypotheses for which a recording's touches are very strong evidence, the best first.

    Images are taken as they are, for their own faults see `hypotheses`. What the model's prior allows for, a
    peg that is a little off in the hand under the profile of a real bench, is no hypothesis. About fifty
    evidences are computed, each for half a second.

    Args:
        model: with a prior and sensors of the part's pose, such as `look_and_touch`; under the profile of a
            bench `model.with_settings(profile="ur5e")`.
        recording: with touches of a held peg that the model explains by its gap to the part
            (`bcppl.sensors.capabilities.FeelsForces`); without any nothing is explained.

    Raises:
        InputError: the model has no prior and sensors, or its prior holds an axis of the pose.
    """
    sensors = getattr(model.prepare(recording), "likelihoods", {}).values()
    if recording.peg is None or not any(isinstance(sensor, FeelsForces) for sensor in sensors):
        return []
    stated = approximated(model, recording)
    if not any(_forces(stated)):
        return []
    families: list[dict[str, Callable[[bool], float]]] = [
        {name: partial(_of_altered, model, altered, stated.fits) for name, altered in family.items()}
        for family in _hypotheses(recording, stated)
    ]
    families.append(_moved(stated))
    hurried, least = log_evidence(_with_contacts(stated, stated.contacts, False)), log_evidence(stated)
    results = []
    for number, family in enumerate(families):
        evidences = {name: evidence(False) for name, evidence in family.items()}
        # What a search from few places finds no better than what is stated is not searched for from many.
        evidences |= {name: family[name](True) for name, found in evidences.items() if found > hurried}
        mean = torch.tensor([*evidences.values()], dtype=torch.float64).logsumexp(0)
        gain = float(mean) - math.log(max(1, len(family))) - least
        if gain > (VERY_STRONG if number else OTHER_ROWS):
            results.append(Explanation(max(evidences, key=evidences.__getitem__), gain))
    return sorted(results, key=lambda one: -one.gain)


def _of_altered(model: Model, altered: Recording, fits: Mapping[str, Any], thorough: bool) -> float:
    return log_evidence(approximated(model, altered, fits, thorough))


def approximated(
    model: Model, recording: Recording, fits: Mapping[str, Any] | None = None, thorough: bool = True
) -> GaussianApproximation:
    """The Gaussian approximation given all of a recording; its images' fits are computed unless given.

    A `thorough` one searches for modes from many places.
    """
    scene = model.prepare(recording)
    approximation = GaussianApproximation(pose=model.pose, scene=scene, fits=fits or {})
    observed = model.observe(scene, recording.measurements)
    for number, measurement in enumerate(recording.measurements):
        action, sensor = measurement.action, scene.sensor(measurement.action)
        known = fits is not None and isinstance(sensor, FitsPose)
        if not known and not (isinstance(sensor, Defers) and sensor.is_deferred(action)):
            approximation = approximation.deferring(scene, number, action, observed)
    return _with_contacts(approximation, approximation.contacts, thorough)


def log_evidence(approximation: GaussianApproximation) -> float:
    """The log-probability of an approximation's touches, given its images, to that of touches by chance.

    By Laplace's method at each mode, for where Gauss-Newton has not converged its quadratic promises too
    much. Beside it stand the directions of the forces, which the likelihood leaves out. By chance a row of a
    contact is anywhere in `FARTHEST`: so hypotheses compare that change how many rows there are.
    """
    prior, modes = approximation.prior, approximation.quadratic
    if modes is None:
        return 0.0
    own = prior.component(modes.around)
    precision = torch.linalg.inv(prior.covariances[own])
    away = poses.log(modes.around, prior.centers[own])
    sizes = torch.linalg.slogdet(precision)[1] - torch.linalg.slogdet(precision + modes.information)[1]
    squared = ((away[:, None] @ precision)[:, 0] * away).sum(dim=1)
    each = modes.log_likelihood + prior.log_weights[own] + 0.5 * (sizes - squared)
    for sensor, contacts in _forces(approximation):
        outwards = _points_outwards(sensor, contacts, modes.around)
        each = each + torch.where(outwards, OUTWARDS, 1.0 - OUTWARDS).log().sum(dim=1)
        each = each + int(sensor.peg_rows(contacts).felt.sum()) * math.log(FARTHEST)
    return float(each.logsumexp(0))


def _points_outwards(sensor: FeelsForces, contacts: Sequence[Approximated], part: Tensor) -> Tensor:
    """Whether the mean force of each contact pushes the peg out of the part, at poses (M, 7): (M, E)."""
    felt = sensor.peg_rows(contacts).contacts
    normal = -sensor.gap(part, felt.world_from_peg).gradient(part)[..., :3]
    episodes, which = felt.episode.unique(return_inverse=True)
    along = (normal * felt.force).sum(dim=-1)
    return along.new_zeros(len(part), len(episodes)).index_add_(1, which, along) > 0.0


def _with_contacts(
    approximation: GaussianApproximation, contacts: Sequence[Approximated], thorough: bool
) -> GaussianApproximation:
    """The approximation of some contacts, all of them: evidences compare only where all count."""
    relevant = {contact.number: True for contact in contacts}
    return replace(
        approximation,
        contacts=tuple(contacts),
        relevant=relevant,
        quadratic=None,
        adapted=None,
        stale=True,
        thorough=thorough,
    ).searched()


def _forces(approximation: GaussianApproximation) -> Iterator[tuple[FeelsForces, list[Approximated]]]:
    """The sensors that feel forces, each with its contacts."""
    for sensor in approximation.scene.likelihoods.values():
        own = [c for c in approximation.contacts if approximation.scene.sensor(c.action) is sensor]
        if own and isinstance(sensor, FeelsForces):
            yield sensor, own


def _hypotheses(recording: Recording, stated: GaussianApproximation) -> Iterator[dict[str, Recording]]:
    """Families of hypotheses, by name in each; that of clocks comes first."""
    yield {
        f"the wrench is read {seconds:g} s {word}": with_wrench_earlier(recording, sign * seconds)
        for sign, word in ((1.0, "late"), (-1.0, "early"))
        for seconds in CLOCK
    }
    yield {"forces and torques have the wrong sign": with_wrench_reversed(recording)}
    assert recording.peg is not None
    width = 2.0 * float(abs(recording.peg.vertices[:, :2]).max())
    yield {
        f"the peg is {1e3 * metres:g} mm {word}": with_peg_thicker(recording, sign * metres)
        for sign, word in ((1.0, "thicker"), (-1.0, "thinner"))
        for metres in THICKNESS
        if metres < 0.2 * width
    }
    if not turns_freely(recording.peg):
        yield {
            f"the peg is turned by {sign * angle:+g}° about its axis in the hand": with_peg_turned(
                recording, math.radians(sign * angle)
            )
            for sign in (1.0, -1.0)
            for angle in TURN
        }
    yield {
        f"the peg's pose is off by {1e3 * along:+.0f} mm along its axis, as that of another frame of the "
        "tool": with_peg_along(recording, along)
        for along in _along(stated)
        if abs(along) > OFF
    }


def _along(stated: GaussianApproximation) -> list[float]:
    """How much farther along its axis the peg may be, m: where touches fit best to the part as it is seen."""
    shifts = torch.arange(-ALONG, ALONG + 0.5 * STEP, STEP, dtype=torch.float64)
    tip = torch.zeros(len(shifts), 3, dtype=torch.float64)
    tip[:, 2] = shifts
    total = torch.zeros(len(shifts), dtype=torch.float64)
    for sensor, contacts in _forces(stated):
        rows = sensor.peg_rows(contacts)
        felt, pose = rows.felt[::FEW], rows.world_from_peg[::FEW]
        turn = pose[:, None, 3:].expand(-1, len(shifts), 4)
        there = torch.cat([poses.transform(pose, tip), turn], dim=2)
        gaps = sensor.gap(stated.prior.centers[:1], there.reshape(-1, 7)).distance.reshape(len(pose), -1)
        misfit = torch.where(felt[:, None], gaps.abs(), (-gaps).clamp(min=0.0))
        # A row that is far off under any shift, an outlier, does not decide.
        total = total + misfit.clamp(max=FAR).sum(dim=0)
    lowest = (total[1:-1] <= total[:-2]) & (total[1:-1] <= total[2:])
    minima = 1 + lowest.nonzero().flatten()
    return shifts[minima[total[minima].argsort()[:MINIMA]]].tolist()


def _moved(stated: GaussianApproximation) -> dict[str, Callable[[bool], float]]:
    """By a time, what gives the evidence of two poses: of the touches before it, and of those after it."""
    evidences: dict[str, Callable[[bool], float]] = {}
    for k in range(1, len(stated.contacts)):
        parts = stated.contacts[:k], stated.contacts[k:]
        # Only before a window in which the peg is felt: one without contact does not tell a new pose.
        before, window = (
            [sensor.peg_rows(own).contacts for sensor, own in _forces(replace(stated, contacts=some))]
            for some in (parts[0], parts[1][:1])
        )
        if not (before and window and len(before[-1].time) and len(window[0].time)):
            continue
        if before[-1].episode[-1] != window[0].episode[0]:
            when = float(window[0].time[0])
            name = f"the part moved, or the peg slipped, before the touch at {when:.2f} s of the probe"
            evidences[name] = partial(_of_parts, stated, parts)
    return evidences


def _of_parts(
    stated: GaussianApproximation, parts: Sequence[Sequence[Approximated]], thorough: bool
) -> float:
    return sum(log_evidence(_with_contacts(stated, part, thorough)) for part in parts)
