"""Slips, slides and outliers of touches: evidence is the sum over all that may have happened, enumerated."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from bcppl.distributions.episodes import Grasp, LinearErrors, PartSlides
from bcppl.distributions.episodes.filter.branches import KEPT
from bcppl.distributions.episodes.linear_errors import Effect
from bcppl.distributions.episodes.prior import nodes_of
from bcppl.distributions.episodes.rows import FORCE
from bcppl.distributions.manifold import FARTHEST
from tests.distributions.touches.test_linear_errors import dense, rows_with_wrenches, site
from tests.distributions.touches.test_manifold import around


def slipped_by(rows: Tensor, begin: int) -> Tensor:
    """Shares (R,) of a change's variances at rows of which a touch has two, by their force."""
    share = (torch.arange(len(rows)) >= begin).double()
    share[begin] = float(rows[begin, FORCE] / rows[begin : begin + 2, FORCE].max())
    return share


def test_a_slip_is_one_of_the_sums_over_when_it_was() -> None:
    """A peg that slips by 0.6 mm before the second of two touches: all times of a slip, enumerated."""
    pose = around(4, 0, 1e-5, 1e-4)
    rows = rows_with_wrenches([1, 1, 1, 1, 1, 1], [0, 0, 1, 1, 2, 2], seed=5)
    rows[:, :2], rows[:, 2], rows[:, 3:7] = 0.0, 0.0, torch.tensor([1.0, 0, 0, 0])
    rows[2:, 2] -= 6e-4
    grasp = Grasp(1e-4, 1e-3, 1e-3, slip=5e-4, slip_turn=1e-3, slips=0.01)
    errors = LinearErrors((grasp,))
    jump = errors.jumps[0].variances
    each = [dense(pose, rows, errors) + 3 * math.log(0.99)]
    for begin in (0, 2, 4):
        slipped = slipped_by(rows, begin)
        extra = torch.minimum(slipped[:, None], slipped)[..., None] * jump
        each.append(dense(pose, rows, errors, extra) + 2 * math.log(0.99) + math.log(0.01))
    expected = torch.logsumexp(torch.stack(each), dim=0)
    torch.testing.assert_close(site(pose, rows, grasp).log_prob(rows), expected, rtol=0.0, atol=0.1)
    after = site(pose, rows, grasp).branches(rows)
    second = (after.weights * (after.event[..., 1] == 2)).sum(axis=1)
    assert bool((second > 0.9).all()), "the second episode is the one before which it slipped"
    assert float((expected - each[0]).min()) > 3.0


@pytest.mark.long
@pytest.mark.parametrize("case", ["slips and slides at once", "slides in a touch that is an outlier"])
def test_evidence_sums_over_all_that_may_have_happened_at_each_touch(case: str) -> None:
    """Nothing, a slip, a slide or both, in a touch that is an outlier or not, enumerated."""
    pose = around(3, 0, 1e-5, 1e-4)
    rows = as_expected()
    if case.startswith("slips"):
        rows[2:, 2] -= 2e-3
    else:
        rows[2:4, 2], rows[4:, 2] = torch.tensor([4e-3, -3e-3]), 7e-4
    errors = LinearErrors((Grasp(1e-4, 1e-3, 1e-3, slip=5e-4, slips=0.05), Tilt(probability=0.05)))
    jumps, outlier = errors.jumps, 1e-3
    assert [round(c.probability, 6) for c in errors.changes] == [0.9025, 0.0475, 0.0475, 0.0025]
    each: list[Tensor] = []
    apart: list[Tensor] = []
    for happened in itertools.product(range(4), (False, True), repeat=3):
        changes, strays = happened[::2], happened[1::2]
        kept = torch.tensor([not stray for stray in strays]).repeat_interleave(2)
        weight, extra = 0.0, torch.zeros(6, 6, len(errors.means), dtype=torch.float64)
        for touch, (change, stray) in enumerate(zip(changes, strays, strict=True)):
            weight += math.log(outlier) - 2 * math.log(FARTHEST) if stray else math.log1p(-outlier)
            for number, jump in enumerate(jumps):
                happens = bool(change >> number & 1)
                weight += math.log(jump.probability if happens else 1.0 - jump.probability)
                share = slipped_by(rows, 2 * touch)
                extra += happens * torch.minimum(share[:, None], share)[..., None] * jump.variances
        log_density = dense(pose, rows[kept], errors, extra[kept][:, kept]) if kept.any() else 0.0
        each.append(torch.as_tensor(log_density + weight, dtype=torch.float64).expand(3))
        together = 3 in changes or any(c and stray for c, stray in zip(changes, strays, strict=True))
        apart += [] if together else each[-1:]
    expected = torch.logsumexp(torch.stack(each), dim=0)
    said = site(pose, rows, *errors.errors, outlier=outlier).log_prob(rows)
    torch.testing.assert_close(said, expected, rtol=0.0, atol=0.2)  # touches that do not surprise are spared
    assert float((expected - torch.logsumexp(torch.stack(apart), dim=0)).min()) > 0.5


def test_a_touch_that_does_not_surprise_is_charged_that_nothing_slipped() -> None:
    """Three touches where they should be: all that may have slipped, enumerated, and nothing alone."""
    pose, rows = around(4, 0, 1e-5, 1e-4), as_expected()
    grasp = Grasp(1e-4, 1e-3, 1e-3, slip=5e-4, slip_turn=1e-3, slips=0.05)
    errors = LinearErrors((grasp,))
    each = []
    for happened in itertools.product((False, True), repeat=3):
        extra = torch.zeros(6, 6, len(errors.means), dtype=torch.float64)
        for touch, slips in enumerate(happened):
            share = slipped_by(rows, 2 * touch)
            extra += slips * torch.minimum(share[:, None], share)[..., None] * errors.jumps[0].variances
        each.append(dense(pose, rows, errors, extra) + sum(math.log(0.05 if s else 0.95) for s in happened))
    expected = torch.logsumexp(torch.stack(each), dim=0)
    torch.testing.assert_close(site(pose, rows, grasp).log_prob(rows), expected, rtol=0.0, atol=0.02)


def test_hypotheses_that_are_dropped_leave_their_weight_to_the_others() -> None:
    """Evidence of the many hypotheses of a bench whose peg may slip is the sum over each alone."""
    pose, rows = around(4, 0, 1e-5, 1e-4), as_expected()
    grasp, every = Grasp(1e-4, 1e-3, 1e-3, slip=5e-4, slip_turn=1e-3, slips=0.05), nodes_of(5e-6, 0.5)
    together = site(pose, rows, grasp, hypotheses=every)
    alone = [each.log_weight + site(pose, rows, grasp, hypotheses=(each,)).log_prob(rows) for each in every]
    assert len(every) > KEPT >= together.branches(rows).number.max()
    expected = torch.logsumexp(torch.stack(alone), dim=0)
    torch.testing.assert_close(together.log_prob(rows), expected, rtol=0.0, atol=0.02)


def as_expected() -> Tensor:
    """Rows of three touches of two rows each, with the peg where it should be."""
    rows = rows_with_wrenches([1] * 6, [0, 0, 1, 1, 2, 2], seed=5)
    rows[:, :3], rows[:, 3:7] = 0.0, torch.tensor([1.0, 0, 0, 0])
    return rows


class Tilt(PartSlides):
    """A slide that lifts the part, so that a peg from above feels it."""

    def effect(self, rows: Tensor) -> Effect:
        return Effect(super().effect(rows).twist[:, [2, 0, 1, 3, 4, 5]], rows.new_zeros(len(rows), 3))
