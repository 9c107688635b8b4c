"""Where touches place a part: Gauss-Newton on the gaps of contact manifolds, from several starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.manifold import ContactManifold, Gaps, MeasuresGap
from bcppl.distributions.pose_normals import Modes

BLURS = (0.003, 0.002, 0.001, 0.0005, 0.0002, 0.0, 0.0, 0.0)  # m that are added to errors, step by step
SHARP = (0.0005, 0.0005, 0.0002, 0.0, 0.0, 0.0, 0.0)  # and where it starts from outside
FINE = (0.0002, 0.0002, 0.0001, 0.00005, 0.0, 0.0, 0.0)  # and where it starts everywhere
_AHEAD = torch.tensor([0.0, 0.003, 0.006, 0.01], dtype=torch.float64)  # m
_SHARES_OF_STEP = torch.tensor([0.0, 0.15, 0.5, 1.0], dtype=torch.float64)
# Where Gauss-Newton starts, in deviations of what is known beside the touches: always the same.
_STARTS = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
_PLACES = torch.randn(32, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
_MOVED = 0.001  # m: less is no direction
# Explanations that are kept: so many at most, with a weight of the best one's by so many nats less, and so
# many squared deviations apart.
_MODES, _FAINT, _SAME = 4, 6.0, 12.0
_LEFT = 12  # starts of those from everywhere that are followed to the end


class Normal(NamedTuple):
    """What is known beside touches: a pose (1, 7), and a precision (1, 6, 6) in its tangent space."""

    center: Tensor
    precision: Tensor


class Told(NamedTuple):
    """What touches say to second order around each of M poses (M, 7) that explain them, the weightiest first.

    Of minus the log-likelihood (M, 6) and (M, 6, 6); and the log-likelihood (M,) there.
    """

    around: Tensor
    slope: Tensor
    information: Tensor
    said: Tensor

    def given(self, center: Tensor, precision: Tensor) -> Modes:
        """What they say together with normals around poses (..., 7): M modes for each."""
        away = poses.local(self.around, center[..., None, :])
        pull = (precision[..., None, :, :] @ away[..., None])[..., 0]
        covariance = torch.linalg.inv(precision[..., None, :, :] + self.information)
        step = (covariance @ (pull - self.slope)[..., None])[..., 0]
        # The integral of both over all poses, by completing the square.
        squares = (step * (pull - self.slope)).sum(dim=-1) - (away * pull).sum(dim=-1)
        sizes = torch.linalg.slogdet(covariance)[1] + torch.linalg.slogdet(precision)[1][..., None]
        return Modes(
            poses.retract(self.around, step),
            0.5 * (covariance + covariance.transpose(-1, -2)),
            self.said + 0.5 * (squares + sizes),
        )


class Window(NamedTuple):
    """One window of a probe.

    Attributes:
        value: (T, 8) what was observed.
        manifold: its likelihood for poses (N, 7), errors so many metres wider, measured by another gap.
    """

    value: Tensor
    manifold: Callable[[Tensor, float, MeasuresGap], ContactManifold]


class _Measured(NamedTuple):
    distance: Tensor
    slopes: Tensor

    def slope(self, world_from_part: Tensor) -> Tensor:
        return self.slopes

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gaps:
        return self


def told_by(
    gap: MeasuresGap,
    windows: Sequence[Window],
    known: Normal,
    before: Tensor | None,
    everywhere: bool = False,
) -> Told:
    """What windows say around the likeliest poses that Gauss-Newton finds.

    It starts from what is known, and from places around it, at first with errors of millimetres. Where a part
    stands too near, a peg is deep in it, and would be led out of a thin wall on the wrong side; so it starts
    from outside as well, the part farther on in the direction in which the peg last met it. Errors of
    millimetres lead all starts to one place, and which corner or edge was touched may be open: `everywhere`
    starts from many places with small errors too, each of which leads to what is near it.

    Args:
        gap: measures gaps.
        windows: those in which the peg was near the part.
        known: beside them.
        before: (M, 7) where fewer windows placed the part; None for none.
        everywhere: whether to look for all that explains them.
    """
    center, precision = known
    scale = torch.linalg.cholesky(torch.linalg.inv(precision[0]))
    starts = [center, poses.retract(center, _STARTS @ scale.T), *([] if before is None else [before[:1]])]
    found = [fitted(gap, windows, torch.cat(starts), known, BLURS)]
    onward = _onward(windows)
    if onward is not None:
        ahead = torch.cat([center, center if before is None else before[:1]]).repeat_interleave(
            len(_AHEAD), 0
        )
        ahead[:, :3] += _AHEAD.repeat(2)[:, None] * onward
        found.append(fitted(gap, windows, ahead, known, SHARP))
    best, _ = max(found, key=lambda fit: float(fit[1][0]))
    others = [] if before is None or len(before) == 1 else [before]
    if everywhere:
        others.append(poses.retract(center, _PLACES @ scale.T))
    if others:
        each, _ = fitted(gap, windows, torch.cat(others), known, FINE, _LEFT)
        best = torch.cat([best, each])
    return _apart(_told(gap, windows, best), known)


def _told(gap: MeasuresGap, windows: Sequence[Window], pose: Tensor, blur: float = 0.0) -> Told:
    """What all windows say around poses (S, 7), or would with errors `blur` metres wider."""
    slope, information = pose.new_zeros(len(pose), 6), pose.new_zeros(len(pose), 6, 6)
    said = pose.new_zeros(len(pose))
    for site, value in _sites(gap, windows, pose, blur):
        quadratic = site.quadratic(value)
        slope, information = slope + quadratic.slope, information + quadratic.information
        said = said + site.log_prob(value)
    return Told(pose, slope, information, said)


def _apart(told: Told, known: Normal) -> Told:
    """Those around which there is weight, and that are not the same: of such the one with more of it."""
    if len(told.around) == 1:
        return told
    away = poses.local(told.around, known.center)
    covariance = torch.linalg.inv(known.precision + told.information)
    # As they are, not where their slopes promise more: Gauss-Newton has got stuck at some.
    weight = told.said - 0.5 * ((away @ known.precision[0]) * away).sum(dim=-1)
    weight = weight + 0.5 * torch.linalg.slogdet(covariance)[1]
    kept: list[int] = []
    for one in weight.argsort(descending=True).tolist():
        if kept and (len(kept) == _MODES or weight[one] < weight[kept[0]] - _FAINT):
            break
        off = poses.local(told.around[kept], told.around[one])
        squared = (off * torch.linalg.solve(covariance[kept], off[..., None])[..., 0]).sum(dim=-1)
        if not bool((squared < _SAME).any()):
            kept.append(one)
    return Told(*(each[kept] for each in told))


def fitted(
    gap: MeasuresGap,
    windows: Sequence[Window],
    starts: Tensor,
    known: Normal,
    blurs: Sequence[float],
    least: int = 1,
) -> tuple[Tensor, Tensor]:
    """The likeliest poses (M, 7) to which Gauss-Newton leads, and their log-probabilities (M,).

    Args:
        gap: measures gaps.
        windows: those in which the peg was near the part.
        known: beside them.
        starts: (S, 7).
        blurs: metres that are added to errors at each step, 0 in the end.
        least: half of the starts are left at each step, but so many in the end.
    """
    center, precision = known
    pose, said = starts, torch.zeros(len(starts))
    for blur in blurs:
        told = _told(gap, windows, pose, blur)
        pull = (precision @ poses.local(pose, center)[..., None])[..., 0] - told.slope
        step = torch.linalg.solve(precision + told.information, pull[..., None])
        # Which corner touches changes on the way: so far and no farther than it gains.
        tried = poses.retract(pose[:, None], _SHARES_OF_STEP[:, None] * step[:, None, :, 0])
        away = poses.local(center, tried.reshape(-1, 7))
        total = -0.5 * ((away @ precision[0]) * away).sum(dim=-1)
        for site, value in _sites(gap, windows, tried.reshape(-1, 7), blur):
            total = total + site.log_prob(value)
        said, farthest = total.reshape(tried.shape[:2]).max(dim=1)
        kept = said.topk(min(len(pose), max(least, len(pose) // 2))).indices
        pose, said = tried[kept, farthest[kept]], said[kept]
    return pose[:least], said[:least]


def _onward(windows: Sequence[Window]) -> Tensor | None:
    """The direction (3,) in which the peg moved when it last met the part; None if it has met none."""
    if not windows:
        return None
    rows = torch.cat([window.value for window in windows])
    felt = rows[:, 7] == 1.0
    onsets = torch.nonzero(felt[1:] & ~felt[:-1])[:, 0]
    if len(onsets) == 0:
        return None
    last = int(onsets[-1])
    way = rows[last + 1, :3] - rows[max(0, last - 2), :3]
    return way / way.norm() if float(way.norm()) > _MOVED else None


def _sites(
    gap: MeasuresGap, windows: Sequence[Window], pose: Tensor, blur: float
) -> Iterator[tuple[ContactManifold, Tensor]]:
    """Each window's likelihood at poses (S, 7), all gaps measured at once."""
    if not windows:
        return
    gaps = gap(pose, torch.cat([window.value[:, :7] for window in windows]))
    slopes, begin = gaps.slope(pose), 0
    for window in windows:
        told = begin + torch.nonzero(~torch.isnan(window.value[:, 7]))[:, 0]
        begin += len(window.value)
        yield window.manifold(pose, blur, _Measured(gaps.distance[:, told], slopes[:, told])), window.value
