"""Posterior predictive checks of a run: a p value for each row, and a warning at the end."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.distributions.checks import THRESHOLD, Check, chi_square
from bcppl.geometry.convex.hausdorff import hausdorff_error
from bcppl.inference.criticism.hypotheses import Displaced, Edge, alternatives, displaced, edges, likeliest
from bcppl.inference.criticism.nuisances import SuddenChange, sudden_changes
from bcppl.inference.criticism.predictive import surprise
from bcppl.inference.criticism.undetermined import Undetermined, undetermined
from bcppl.inference.population import Population
from bcppl.recordings import Recording

MARK = "!"
NAMED = 6  # measurements that a warning names
DOUBTFUL = 0.02  # a p value that with a jump of the belief is worth a warning: neither is by itself
FINEST = 1e-5  # m: a belief is not taken to be surer than this of where the part is
PIECES = 0.01  # of a part's diameter: convex pieces that are so far off its mesh are warned of
MEANING = {
    "image": "an unmodelled object may occlude the view, the camera may not be where it is stated to be, or "
    "the part may have another shape or have moved",
    "through": "the part is seen through where it is believed to be, so that it may have moved or have "
    "another shape",
    "normal": "a camera, or another latent value, may be farther off than its prior allows",
    "touch": "the part may have moved between touches, or the finger may have touched something else",
    "contacts": "the peg may have touched something else, slipped in the hand or bent, or the part may have "
    "moved or have another shape",
}


class MeanJump(NamedTuple):
    """A measurement after which the mean position is where the belief before it had it least of all.

    Attributes:
        label: of the measurement.
        distance: from mean to mean, metres.
        check: of the difference, whitened by the covariance of the belief before it, against chi-square.
    """

    label: str
    distance: float
    check: Check


@dataclass
class PredictiveChecks:
    """The checks of a run so far.

    Attributes:
        labels: of the measurement that each address came with.
        jump: of the mean, the least probable so far: that of a belief is a martingale, a moved part's is not.
        before: the belief before the newest measurement.
    """

    labels: dict[str, str] = field(default_factory=dict)
    jump: MeanJump | None = None
    before: Belief | None = None

    @classmethod
    def resumed(
        cls, labels: Mapping[str, str], history: Sequence[tuple[str, Belief]], sites: Collection[str]
    ) -> PredictiveChecks:
        """The checks of a run that was stopped: `labels` as they were, for the addresses that there are."""
        checks = cls({address: labels[address] for address in sites if address in labels})
        for label, belief in history:
            checks.compare(belief, label)
        return checks

    def cell(self, step: Any) -> str:
        """The p value of a step's measurement, marked where it is small; empty where there is none."""
        population = getattr(step, "population", None)
        if not isinstance(population, Population):
            return ""
        self.compare(step.belief, step.info.label)
        new = [a for a in population.trace.addresses if a not in self.labels]
        is_prior = not self.labels
        self.labels.update(dict.fromkeys(new, step.info.label))
        checks = {} if is_prior else surprise(population, new)
        if not checks:
            return ""
        probability = together(checks.values())
        return f"<{THRESHOLD:g}{MARK}" if probability < THRESHOLD else f"{probability:.3f}"

    def compare(self, belief: Belief, label: str) -> None:
        """Keep the jump of the mean at a measurement if it is the farthest so far, in standard deviations."""
        before, self.before = self.before, belief
        if before is None:
            return
        away = poses.local(before.mean, belief.mean)[:3]
        scale = torch.linalg.cholesky(
            before.covariance[:3, :3] + FINEST**2 * torch.eye(3, dtype=torch.float64)
        )
        white = torch.linalg.solve_triangular(scale, away[:, None], upper=False)
        jump = MeanJump(label, float(away.norm()), chi_square(white.square().sum(dim=0), 3))
        if self.jump is None or jump.check.excess > self.jump.check.excess:
            self.jump = jump

    def warnings(self, step: Any, address: str) -> list[str]:
        """One sentence on each reason to doubt the belief of the last step; empty where there is none.

        `address` is that of the sought pose.
        """
        population = getattr(step, "population", None)
        if not isinstance(population, Population):
            return []
        by_label: dict[str, dict[str, Check]] = {}
        for at, check in surprise(population, list(self.labels)).items():
            by_label.setdefault(self.labels[at], {})[at] = check
        off = {label: checks for label, checks in by_label.items() if together(checks.values()) < THRESHOLD}
        reasons = [sentence(off, list(by_label))] if off else []
        beside = displaced(population)
        if beside:
            reasons.append(displaced_sentence({self.labels[each.address]: each for each in beside}))
        reasons += [edge_sentence(edge) for edge in edges(population, address) if edge.decisive or off]
        open_along = undetermined(population, address)
        if open_along is not None:
            reasons.append(open_sentence(open_along))
        reasons += [change_sentence(change) for change in sudden_changes(population)]
        others = alternatives(population)
        if others:
            reasons.append(
                f"the images fit a part that is {likeliest(others)} better by {others[0].gain:.0f} nats: "
                "check the mesh's axes and handedness, and how the part was put down."
            )
        least = min((together(checks.values()) for checks in by_label.values()), default=1.0)
        if self.jump is not None and self.jump.check.surprising and (reasons or least < DOUBTFUL):
            reasons.insert(1, jump_sentence(self.jump))
        return reasons


def piece_errors(recording: Recording) -> list[str]:
    """One sentence on each solid of a recording whose convex pieces are not its mesh."""
    wrong = []
    for solid in (recording.part, recording.peg):
        if solid is None or not solid.pieces or not solid.is_closed:
            continue
        error = hausdorff_error(solid, count=1000)
        if error.largest > PIECES * solid.diameter:
            wrong.append(
                f"the convex pieces of part {solid.name!r} extend {1e3 * error.added:.2g} mm beyond its mesh "
                f"and lack up to {1e3 * error.lost:.2g} mm of it: it is touched as another shape than it is "
                "seen as; decompose it again (bcppl.geometry.convex.decomposition)."
            )
    return wrong


def together(checks: Collection[Check]) -> float:
    """The p value of several sites together, after Bonferroni."""
    return min(1.0, len(checks) * min(check.probability for check in checks))


def edge_sentence(edge: Edge) -> str:
    """The warning for a belief that is piled up at the edge of the guess."""
    unit, scale = ("mm", 1e3) if edge.axis in "xyz" else ("°", math.degrees(1.0))
    if edge.outside > 0.5:
        return (
            f"{100 * edge.outside:.0f} % of the posterior is outside the guess, beyond {edge.axis} "
            f"{scale * edge.limit:+.3g} {unit} from its centre: "
            "widen the guess, or check the frame that it is stated in."
        )
    better = ""
    if edge.decisive:
        beyond = f"{scale * edge.beyond:.2g} {unit} beyond it"
        better = f", and the measurements fit better by {edge.gain:.0f} nats {beyond}"
    return (
        f"{100 * edge.mass:.0f} % of the posterior is at the edge of the guess, {edge.axis} "
        f"{scale * edge.limit:+.3g} {unit} from its centre{better}: the part may be outside; widen the guess."
    )


def jump_sentence(jump: MeanJump) -> str:
    """The warning for a belief that has left the place that it was sure of."""
    return (
        f"the belief moved by {1e3 * jump.distance:.2g} mm at {jump.label}, to where it had been sure that "
        "the part was not: as if the part had moved before it, or the belief had been wrong."
    )


def displaced_sentence(beside: Mapping[str, Displaced]) -> str:
    """The warning for images, by the label of their measurement, that see the part elsewhere."""
    listed = "; ".join(
        f"{label} {1e3 * each.distance:.2g} mm away, by {each.gain:.0f} nats"
        for label, each in list(beside.items())[:NAMED]
    )
    return (
        f"images fit the part better elsewhere than it is believed to be ({listed}): the part may have moved "
        "between measurements, the camera may not be where it is stated to be, or the belief is wrong."
    )


def change_sentence(change: SuddenChange) -> str:
    """The warning for what has changed between touches, which the belief allows for."""
    return (
        f"{change.name} before the touch at {change.time:.2f} s of the probe (probability "
        f"{change.probability:.2f}): the belief allows for it; hold peg and part more firmly, or press less."
    )


def open_sentence(where: Undetermined) -> str:
    """The warning for a direction in which the position is as open as the guess left it."""
    direction = ", ".join(f"{0.0 + round(x, 2):g}" for x in where.direction.tolist())
    return (
        f"the measurements hardly determine the part's position along ({direction}) in the world: its "
        f"standard deviation there is {1e3 * where.deviation:.2g} mm, and the guess's at most "
        f"{1e3 * where.before:.2g} mm: touch a face across that direction, or look from another side."
    )


def sentence(off: Mapping[str, Mapping[str, Check]], checked: Sequence[str] = ()) -> str:
    """The warning for measurements that fail their check, by measurement and address.

    `checked` are the labels of all measurements that were checked, in their order.
    """
    labels = list(off)
    more = f" and {len(labels) - NAMED} more" if len(labels) > NAMED else ""
    kinds = dict.fromkeys(
        min(checks.values(), key=lambda check: check.probability).kind for checks in off.values()
    )
    verb = "does" if len(labels) == 1 else "do"
    count = len(labels)
    first = list(checked[:count]) == labels
    moved = ""
    if 1 < count < len(checked) and (first or list(checked[-count:]) == labels):
        where = f"up to {labels[-1]}" if first else f"from {labels[0]} on"
        moved = f"all {where}, as if the part had moved: "
    meant = ", or ".join(MEANING[kind] for kind in kinds)
    return (
        f"posterior predictive check: {', '.join(labels[:NAMED])}{more} {verb} not fit the final belief "
        f"(p value below {THRESHOLD:g}): {moved}{meant}, or the belief is wrong; "
        "look at the measurement, and try more particles or another seed."
    )
