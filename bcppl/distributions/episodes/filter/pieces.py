"""A piece of an episode of contact: what may have happened in it, and which of that is kept."""

from __future__ import annotations

import math

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled
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
    copy_matrix,
    copy_vector,
    dot,
    factorise,
    informed,
    set_joint,
    squared_by,
    whiten,
)
from bcppl.distributions.episodes.filter.free_rows import LOG_TWO_PI, log_sum
from bcppl.distributions.episodes.filter.gaps import Gaps, line
from bcppl.distributions.episodes.filter.workspace import Workspace

# Nats below the most probable hypothesis, from which on one is dropped: at the release of a touch the right
# delay of the wrench was 12 below another, and in the end 46 above it.
FAINT = 25.0
_UNLIKELY = 10.0  # the same before an episode, of a hypothesis with a change
_SURPRISING = 1.0  # standard deviations of a chi-square


@compiled
def weigh_candidates(
    n: int,
    s: int,
    after: Branches,
    prior: Prior,
    segments: Segments,
    gaps: Gaps,
    room: Workspace,
    alike: bool,
) -> int:
    """Weigh what may have happened to a particle's hypotheses in a piece; returns how many candidates.

    With errors `alike` in all particles nothing is shared by the touches, and no parameter changes but the
    contact's own.
    """
    first, last, found = segments.first[s], segments.last[s], 0
    rows, number = last - first, after.number[n]
    changes = len(prior.change_log_probability) if segments.slips[s] else 1
    loaded, residual = segments.loaded[first:last], gaps.residual[n, first:last]
    log_in = math.log1p(-prior.outlier)
    log_out = math.log(prior.outlier) if prior.outlier > 0.0 else -np.inf
    stray = log_out - rows * math.log(prior.farthest)
    likely = after.log_weight[n, :number].max() - _UNLIKELY
    for b in range(number):
        h, log_weight = after.which[n, b], after.log_weight[n, b]
        mean, covariance = after.mean[n, b], after.covariance[n, b]
        if segments.begins[s] == 1:
            begin_contact(mean, covariance, segments.common[h])
        slope, pulls, joint = room.columns[prior.delay[h], :rows], room.pulls[b, :rows], room.joints[b]
        _predict(n, b, s, h, mean, slope, prior, segments, gaps, room)
        if not alike:
            np.dot(slope, covariance, pulls)
            set_joint(slope, pulls, segments.errors[h, first:last], residual, joint[:rows])
        for change in range(changes):
            if change and log_weight + prior.change_log_probability[change] < likely:
                continue
            if alike:
                log_determinant, square = _contact_given(b, s, h, mean, covariance, segments, room)
            else:
                _set_change(change, h, prior, room.changed)
                log_determinant = factorise(joint[:rows], slope, room.changed, loaded, room.factor)
                square = whiten(room.factor, room.error[b, :rows], room.white)
            log_density = -0.5 * (square + log_determinant + rows * LOG_TWO_PI)
            inlier, outlier = log_weight + log_in + log_density, log_weight + stray
            room.square[found], room.source[found] = square, b
            room.kind[found] = 2 * change + INLIER
            surprise = square - rows > _SURPRISING * math.sqrt(2.0 * rows) + 1.0
            if alike or (change == 0 and not surprise):
                # Nothing differs between the two but a state that is hardly ever the outlier's.
                room.weight[found] = log_sum(inlier, outlier)
                if alike:
                    _mix(b, math.exp(inlier - room.weight[found]), mean, covariance, room)
                found += 1
                break
            chance = prior.change_log_probability[change] if segments.slips[s] else 0.0
            room.weight[found], room.weight[found + 1] = inlier + chance, outlier + chance
            room.square[found + 1], room.source[found + 1] = square, b
            room.kind[found + 1] = 2 * change + OUTLIER
            found += 2
    return found


@compiled
def keep_best(
    n: int,
    s: int,
    episode: int,
    found: int,
    after: Branches,
    prior: Prior,
    segments: Segments,
    room: Workspace,
    alike: bool,
) -> None:
    """Make the best of the candidates a particle's hypotheses, their parameters given the piece."""
    first, last = segments.first[s], segments.last[s]
    rows, size, parameters = last - first, after.log_weight.shape[1], after.mean.shape[2]
    # Without sudden changes branches are the prior's hypotheses, and hardly multiply.
    most = size if len(prior.change_log_probability) == 1 else KEPT
    best, left, seen, number = room.weight[:found].max(), 0, 0, after.number[n]
    crowded = found > most
    if crowded:
        _lead(n, found, best, after, prior, room)
    old = room.old
    for b in range(number):
        old.which[0, b] = after.which[n, b]
        copy_vector(after.event[n, b], old.event[0, b])
        copy_vector(after.squared[n, b], old.squared[0, b])
        copy_vector(after.mean[n, b], old.mean[0, b])
        copy_matrix(after.covariance[n, b], old.covariance[0, b])
    while left < most and seen < found:
        c, seen = seen, seen + 1
        if crowded:
            c = int(room.rank[:found].argmax())
            room.rank[c] = -np.inf
        if room.weight[c] < best - FAINT:
            continue
        b, change = room.source[c], room.kind[c] // 2
        h = old.which[0, b]
        mean, covariance = after.mean[n, left], after.covariance[n, left]
        after.log_weight[n, left], after.which[n, left] = room.weight[c], h
        _set_change(change, h, prior, room.changed)
        if alike:
            copy_vector(room.later_mean[b], mean)
            copy_matrix(room.later_covariance[b], covariance)
        else:
            copy_vector(old.mean[0, b], mean)
            copy_matrix(old.covariance[0, b], covariance)
            if room.kind[c] % 2 == INLIER:
                slope, loaded = room.columns[prior.delay[h], :rows], segments.loaded[first:last]
                factorise(room.joints[b, :rows], slope, room.changed, loaded, room.factor)
                whiten(room.factor, room.error[b, :rows], room.white)
                condition(
                    room.factor,
                    room.white[:rows],
                    room.pulls[b],
                    slope,
                    room.changed,
                    loaded,
                    room.gain[:rows],
                    mean,
                    covariance,
                )
        # As an outlier it says nothing of what has changed, but what comes after it does.
        for a in range(parameters):
            covariance[a, a] += room.changed[a]
        copy_vector(old.event[0, b], after.event[n, left])
        copy_vector(old.squared[0, b], after.squared[n, left])
        after.event[n, left, episode], after.squared[n, left, episode] = room.kind[c], room.square[c]
        left += 1
    after.number[n] = left


@compiled
def _predict(
    n: int,
    b: int,
    s: int,
    h: int,
    mean: Array,
    slope: Array,
    prior: Prior,
    segments: Segments,
    gaps: Gaps,
    room: Workspace,
) -> None:
    """Set a hypothesis's errors at a piece, and the gaps with its delay unless they are known."""
    delay, first, of_contact = prior.delay[h], segments.first[s], len(mean) - OF_CONTACT
    for i in range(len(slope)):
        share = gaps.trust[n, delay, first + i] if gaps.trust.size else 1.0
        if not room.filled[delay]:
            room.distance[delay, i] = line(gaps, n, delay, first + i, slope[i])
            slope[i] *= share
            slope[i, of_contact], slope[i, of_contact + 1] = 1.0, gaps.force[first + i]
        room.error[b, i] = dot(slope[i], mean) + share * (
            room.distance[delay, i] + prior.compliance[h] * gaps.force[first + i]
        )
    room.filled[delay] = True


@compiled
def _set_change(change: int, h: int, prior: Prior, changed: Array) -> None:
    for a in range(len(changed)):
        changed[a] = prior.change_variance[change, a] * prior.scale[h] ** 2


@compiled
def _contact_given(
    b: int, s: int, h: int, mean: Array, covariance: Array, segments: Segments, room: Workspace
) -> tuple[float, float]:
    """Set the covariance of a contact's parameters given a piece, and by how much their mean has moved.

    Returns:
        the logarithm of the determinant of the gaps' covariance, and their squared whitened errors.
    """
    first, last = segments.first[s], segments.last[s]
    square = whiten(segments.factor[h, first:last], room.error[b, : last - first], room.white)
    later, log_determinant = room.later_covariance[b], segments.log_determinant[h, s]
    log_determinant += informed(covariance, segments.known[h, s], later)
    for a in range(OF_CONTACT):
        room.pull[a] = dot(segments.white[h, first:last, a], room.white[: last - first])
    return log_determinant, square - squared_by(later, room.pull, room.moved)


@compiled
def _mix(b: int, inside: float, mean: Array, covariance: Array, room: Workspace) -> None:
    """Set the moments of a contact's parameters given a piece that with some probability is no outlier."""
    later, moved = room.later_covariance[b], room.moved
    for a in range(OF_CONTACT):
        room.later_mean[b, a] = mean[a] - inside * moved[a]
        for c in range(OF_CONTACT):
            spread = inside * (1.0 - inside) * moved[a] * moved[c]
            within = inside * later[a, c] + (1.0 - inside) * covariance[a, c]
            later[a, c] = within + spread


@compiled
def _lead(n: int, found: int, best: float, after: Branches, prior: Prior, room: Workspace) -> None:
    """Rank candidates by weight, but the best of each delay first: no other way leads back to one gone."""
    copy_vector(room.weight[:found], room.rank)
    room.leading[:] = -1
    for c in range(found):
        delay = prior.delay[after.which[n, room.source[c]]]
        if room.leading[delay] < 0 or room.weight[c] > room.weight[room.leading[delay]]:
            room.leading[delay] = c
    for delay in range(len(room.leading)):
        if room.leading[delay] >= 0:
            room.rank[room.leading[delay]] = best
