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
probability is conditional on those before it, and those that are kept take the weight of all, so that the
product is a density of all rows; what may change in a piece that does not surprise is left out of it.

A row without contact has the probability that its gap is positive, or about zero where the peg rubs along
the part, and the parameters the first two moments given that (assumed density filtering).
"""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from bcppl.compiled import compiled
from bcppl.devices import numbers
from bcppl.distributions.episodes.displaced import Lines
from bcppl.distributions.episodes.filter.branches import (
    INLIER,
    KEPT,
    OF_CONTACT,
    OUTLIER,
    Branches,
    Prior,
    Segments,
)
from bcppl.distributions.episodes.filter.conditioning import (
    begin_contact,
    condition,
    dot,
    factorise,
    informed,
    set_joint,
    squared_by,
    whiten,
)
from bcppl.distributions.episodes.filter.free_rows import (
    BETWEEN,
    CLEAR,
    LOG_TWO_PI,
    RUBBING,
    log_free,
    log_sum,
    log_total,
)
from bcppl.distributions.episodes.filter.gaps import Gaps, line
from bcppl.threads import parallel_sum, thread_count

# Nats below the most probable hypothesis, from which on one is dropped: at the release of a touch the right
# delay of the wrench was 12 below another, and in the end 46 above it.
FAINT = 25.0
_UNLIKELY = 10.0  # the same before an episode, of a hypothesis with a change
_SURPRISING = 1.0  # standard deviations of a chi-square
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
    number, log_weight, which, mean, covariance, event, squared = after
    parameters, changes, size = mean.shape[2], len(prior.change_log_probability), log_weight.shape[1]
    known, longest, most = (
        before.event.shape[2],
        int((segments.last - segments.first).max()),
        2 * size * changes,
    )
    log_in = math.log1p(-prior.outlier)
    log_out = math.log(prior.outlier) if prior.outlier > 0.0 else -np.inf
    # Without sudden changes branches are the prior's hypotheses, and hardly multiply.
    kept_branches = size if changes == 1 else KEPT
    # Candidates at one episode: which branch each comes from, and what happens.
    weight, source, kind = np.empty(most), np.empty(most, np.int64), np.empty(most, np.int64)
    square, error, white = np.empty(most), np.empty((size, longest)), np.empty(longest)
    rank, leading = np.empty(most), np.empty(len(gaps.late), np.int64)
    pulls = np.empty((size, longest, parameters))
    joints, factor = np.empty((size, longest, longest)), np.empty((longest, longest))
    # Of a segment: its gaps with each delay, and for which delays they are known.
    delays = len(gaps.late)
    distance, columns = np.empty((delays, longest)), np.empty((delays, longest, parameters))
    filled = np.empty(delays, np.bool_)
    # Without shared errors an episode's errors are correlated alike in all particles.
    alike = parameters == OF_CONTACT and gaps.residual.shape[2] == 0
    of_contact = parameters - OF_CONTACT
    later_mean, later_covariance = np.empty((size, OF_CONTACT)), np.empty((size, OF_CONTACT, OF_CONTACT))
    moved = np.empty(OF_CONTACT)
    pull, gain, changed = np.empty(parameters), np.empty((longest, parameters)), np.empty(parameters)
    old_which, old_event, old_squared = which[0].copy(), event[0].copy(), squared[0].copy()
    old_mean, old_covariance = mean[0].copy(), covariance[0].copy()
    for n in range(begin, end):
        own, kept = n if len(before.mean) > 1 else 0, n if len(before.which) > 1 else 0
        for b in range(number[n]):
            h = before.which[kept, b]
            # Before the first row a state is that of its hypothesis, and held once for all particles.
            place = h if len(before.which) > len(before.mean) else b
            log_weight[n, b], which[n, b] = before.log_weight[kept, b], h
            mean[n, b], covariance[n, b] = before.mean[own, place], before.covariance[own, place]
            event[n, b, :known], squared[n, b, :known] = before.event[own, place], before.squared[own, place]
        episode = known
        for s in range(len(segments.first)):
            first, last = segments.first[s], segments.last[s]
            filled[:] = False
            if segments.contact[s] == 0:
                score, positive, either = np.nan, 0.0, 0.0
                for b in range(number[n]):
                    delay = prior.delay[which[n, b]]
                    column = columns[delay, 0]
                    if not filled[delay]:
                        distance[delay, 0], filled[delay] = line(gaps, n, delay, first, column), True
                    if distance[delay, 0] > CLEAR:
                        continue
                    gap = distance[delay, 0] + dot(column, mean[n, b])
                    variance = segments.own[which[n, b], first] + squared_by(covariance[n, b], column, pull)
                    variance += dot(gaps.residual[n, first], gaps.residual[n, first])
                    root = math.sqrt(variance)
                    # Hypotheses that differ in the compliance alone are the same without contact.
                    if gap / root + BETWEEN != score:
                        score = gap / root + BETWEEN
                        positive = log_free(score)
                        either = log_sum(log_in + positive, log_out)
                    inside = log_in + positive
                    log_weight[n, b] += either
                    if not alike and inside > log_out and positive < 0.0:
                        density = math.exp(-0.5 * score**2 - 0.5 * LOG_TWO_PI - positive)
                        hazard = density * (1.0 - RUBBING * score)
                        bend = density * (score + RUBBING - RUBBING * score**2) + hazard**2
                        bend = max(bend, 0.0) / variance
                        for a in range(parameters):
                            mean[n, b, a] += pull[a] / root * hazard
                            share = pull[a] * bend
                            for c in range(parameters):
                                covariance[n, b, a, c] -= share * pull[c]
                continue
            rows, found = last - first, 0
            left_over = gaps.residual[n, first:last]
            loaded = segments.loaded[first:last]
            stray = log_out - rows * math.log(prior.farthest)
            likely = log_weight[n, : number[n]].max() - _UNLIKELY
            for b in range(number[n]):
                h = which[n, b]
                delay = prior.delay[h]
                if segments.begins[s] == 1:
                    begin_contact(mean[n, b], covariance[n, b], segments.common[h])
                slope, own_pull, joint = columns[delay, :rows], pulls[b, :rows], joints[b]
                for i in range(rows):
                    share = gaps.trust[n, delay, first + i] if gaps.trust.size else 1.0
                    if not filled[delay]:
                        distance[delay, i] = line(gaps, n, delay, first + i, slope[i])
                        slope[i] *= share
                        slope[i, of_contact], slope[i, of_contact + 1] = 1.0, gaps.force[first + i]
                    error[b, i] = dot(slope[i], mean[n, b]) + share * (
                        distance[delay, i] + prior.compliance[h] * gaps.force[first + i]
                    )
                filled[delay] = True
                if not alike:
                    np.dot(slope, covariance[n, b], own_pull)
                    set_joint(slope, own_pull, segments.errors[h, first:last], left_over, joint[:rows])
                for change in range(changes if segments.slips[s] else 1):
                    if change and log_weight[n, b] + prior.change_log_probability[change] < likely:
                        continue
                    for a in range(parameters):
                        changed[a] = prior.change_variance[change, a] * prior.scale[h] ** 2
                    if alike:
                        log_determinant = segments.log_determinant[h, s]
                        square[found] = whiten(segments.factor[h, first:last], error[b, :rows], white)
                        later = later_covariance[b]
                        log_determinant += informed(covariance[n, b], segments.known[h, s], later)
                        for a in range(OF_CONTACT):
                            pull[a] = dot(segments.white[h, first:last, a], white[:rows])
                        square[found] -= squared_by(later, pull, moved)
                    else:
                        log_determinant = factorise(joint[:rows], slope, changed, loaded, factor)
                        square[found] = whiten(factor, error[b, :rows], white)
                    log_density = -0.5 * (square[found] + log_determinant + rows * LOG_TWO_PI)
                    inlier = log_weight[n, b] + log_in + log_density
                    outlier = log_weight[n, b] + stray
                    source[found], source[found + 1] = b, b
                    kind[found], kind[found + 1] = 2 * change + INLIER, 2 * change + OUTLIER
                    if alike:
                        # Nothing differs between the two but the contact's parameters: their moments.
                        weight[found] = log_sum(inlier, outlier)
                        inside = math.exp(inlier - weight[found])
                        for a in range(OF_CONTACT):
                            later_mean[b, a] = mean[n, b, a] - inside * moved[a]
                            for c in range(OF_CONTACT):
                                spread = inside * (1.0 - inside) * moved[a] * moved[c]
                                within = inside * later[a, c] + (1.0 - inside) * covariance[n, b, a, c]
                                later[a, c] = within + spread
                        found += 1
                        break
                    chance = prior.change_log_probability[change] if segments.slips[s] else 0.0
                    surprise = square[found] - rows > _SURPRISING * math.sqrt(2.0 * rows) + 1.0
                    if change == 0 and not surprise:
                        # Nothing differs between the two but a state that is hardly ever the outlier's.
                        weight[found] = log_sum(inlier, outlier) + chance
                        found += 1
                        break
                    weight[found], weight[found + 1] = inlier + chance, outlier + chance
                    square[found + 1] = square[found]
                    found += 2
            best, left, known_branches = weight[:found].max(), 0, number[n]
            crowded, seen = found > kept_branches, 0
            if crowded:
                # The best of each delay comes first: no other way leads back to one that is gone.
                rank[:found], leading[:] = weight[:found], -1
                for c in range(found):
                    delay = prior.delay[which[n, source[c]]]
                    if leading[delay] < 0 or weight[c] > weight[leading[delay]]:
                        leading[delay] = c
                for delay in range(delays):
                    if leading[delay] >= 0:
                        rank[leading[delay]] = best
            old_which[:], old_event[:], old_squared[:] = which[n], event[n], squared[n]
            old_mean[:known_branches], old_covariance[:known_branches] = (
                mean[n, :known_branches],
                covariance[n, :known_branches],
            )
            while left < kept_branches and seen < found:
                c, seen = seen, seen + 1
                if crowded:
                    c = int(rank[:found].argmax())
                    rank[c] = -np.inf
                if weight[c] < best - FAINT:
                    continue
                b, change = source[c], kind[c] // 2
                h = old_which[b]
                for a in range(parameters):
                    changed[a] = prior.change_variance[change, a] * prior.scale[h] ** 2
                log_weight[n, left], which[n, left] = weight[c], h
                mean[n, left], covariance[n, left] = old_mean[b], old_covariance[b]
                if alike:
                    mean[n, left], covariance[n, left] = later_mean[b], later_covariance[b]
                elif kind[c] % 2 == INLIER:
                    slope = columns[prior.delay[h], :rows]
                    factorise(joints[b, :rows], slope, changed, loaded, factor)
                    whiten(factor, error[b, :rows], white)
                    condition(
                        factor,
                        white[:rows],
                        pulls[b],
                        slope,
                        changed,
                        loaded,
                        gain[:rows],
                        mean[n, left],
                        covariance[n, left],
                    )
                # As an outlier it says nothing of what has changed, but what comes after it does.
                for a in range(parameters):
                    covariance[n, left, a, a] += changed[a]
                event[n, left], squared[n, left] = old_event[b], old_squared[b]
                event[n, left, episode], squared[n, left, episode] = kind[c], square[c]
                left += 1
            if crowded:
                # What is kept stands for what is not.
                log_weight[n, :left] += log_total(weight[:found]) - log_total(log_weight[n, :left])
            number[n], episode = left, episode + 1
