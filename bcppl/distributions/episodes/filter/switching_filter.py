"""A Rao-Blackwellised filter over the episodes of a probe: Gaussian errors that all touches share, and jumps.

The gap at a row is the measured one plus a linear function of M parameters, which are normal a priori, plus
the row's own errors, which are normal and correlated within a piece of an episode. Two of the parameters are
of the present contact and begin again with another: an offset, and its compliance. So given what is discrete
the parameters are normal at any time and are integrated out by a Kalman filter, one for each hypothesis: of
the contact's compliance and the noise's scale from the beginning, of a change of some parameters in a piece,
or of an outlier, where a piece surprises. A change is a Wiener process that runs while a contact is loaded
more than it was: what is held by friction slips then, at once or slowly, and not under a steady force.
Hypotheses multiply there, and the most probable ones are kept (a Gaussian mixture filter: Alspach and
Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, IEEE TAC 17, 1972). Each row's
probability is conditional on those before it, so the product is a density of all rows, whatever was dropped,
but for the share of what was.

A row without contact has the probability that its gap is positive, or about zero where the peg rubs along
the part, and the parameters the first two moments given that (assumed density filtering).
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from bcppl.compiled import compiled
from bcppl.devices import numbers
from bcppl.distributions.episodes.displaced import Lines
from bcppl.distributions.episodes.filter.branches import KEPT, OF_CONTACT, Branches, Prior, Segments
from bcppl.distributions.episodes.filter.conditioning import copy_matrix, copy_vector
from bcppl.distributions.episodes.filter.free_rows import assimilate_free
from bcppl.distributions.episodes.filter.gaps import Gaps
from bcppl.distributions.episodes.filter.pieces import keep_best, weigh_candidates
from bcppl.distributions.episodes.filter.workspace import workspace
from bcppl.threads import parallel_sum, thread_count

# Particles of a chunk of work, and rows of all of them, at least: fewer take less than to wake a thread.
_CHUNK, _ROWS = 8, 2000


def filtered(
    before: Branches,
    prior: Prior,
    segments: Segments,
    lines: Lines,
    force: Tensor,
    gradient: Tensor | None = None,
    trust: Tensor | None = None,
) -> Branches:
    """The hypotheses after further rows.

    Args:
        before: after the rows before these.
        prior: of all hypotheses.
        segments: of these rows.
        lines: the gaps at these rows.
        force: (R,) N.
        gradient: (N, R, P) the gap's derivatives by P parameters before the shared errors; none unless given.
        trust: (N, D, R) factors of the errors and columns of contacts; 1 unless given.
    """
    if not len(segments.first):
        return before
    particles, (_, branches, known) = len(before.number), before.event.shape
    size, parameters = (particles, max(KEPT, branches)), before.mean.shape[2]
    episodes = known + int(segments.contact.sum())
    # Memory that is only asked for: what no branch uses is never touched.
    after = Branches(
        before.number.copy(),
        np.zeros(size),
        np.zeros(size, np.int64),
        np.zeros((*size, parameters)),
        np.zeros((*size, parameters, parameters)),
        np.zeros((*size, episodes), np.int64),
        np.zeros((*size, episodes)),
    )

    own = lines.slope.new_zeros(*lines.distance.shape, 0) if gradient is None else gradient
    trust = lines.slope.new_zeros(0, 0, 0) if trust is None else trust
    of_lines = (lines.slope, lines.late, lines.twist, lines.offset)
    arrays = (lines.distance, force, own, *of_lines, trust, lines.residual)
    given = Gaps(*(np.ascontiguousarray(numbers(each)) for each in arrays))

    def work(begin: int, end: int) -> int:
        _filter(begin, end, before, after, prior, segments, given)
        return 0

    rows = max(1, len(force))
    parallel_sum(work, 0, particles, max(_CHUNK, _ROWS // rows), thread_count())
    return after


@compiled
def _filter(
    begin: int,
    end: int,
    before: Branches,
    after: Branches,
    prior: Prior,
    segments: Segments,
    gaps: Gaps,
) -> None:
    room = workspace(after, prior, segments, gaps)
    # Without shared errors an episode's errors are correlated alike in all particles.
    alike = after.mean.shape[2] == OF_CONTACT and gaps.residual.shape[2] == 0
    for n in range(begin, end):
        _restore(n, before, after)
        episode = before.event.shape[2]
        for s in range(len(segments.first)):
            room.filled[:] = False
            if segments.contact[s] == 0:
                assimilate_free(n, s, after, prior, segments, gaps, room, not alike)
            else:
                found = weigh_candidates(n, s, after, prior, segments, gaps, room, alike)
                keep_best(n, s, episode, found, after, prior, segments, room, alike)
                episode += 1


@compiled
def _restore(n: int, before: Branches, after: Branches) -> None:
    """Begin a particle with its hypotheses after the rows before."""
    own, kept = n if len(before.mean) > 1 else 0, n if len(before.which) > 1 else 0
    for b in range(after.number[n]):
        h = before.which[kept, b]
        # Before the first row a state is that of its hypothesis, and held once for all particles.
        place = h if len(before.which) > len(before.mean) else b
        after.log_weight[n, b], after.which[n, b] = before.log_weight[kept, b], h
        copy_vector(before.mean[own, place], after.mean[n, b])
        copy_matrix(before.covariance[own, place], after.covariance[n, b])
        copy_vector(before.event[own, place], after.event[n, b])
        copy_vector(before.squared[own, place], after.squared[n, b])
