"""Where touches place a part: Gauss-Newton on the gaps of contact manifolds, from several starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.manifold import ContactManifold, Gaps, MeasuresGap

BLURS = (0.003, 0.002, 0.001, 0.0005, 0.0002, 0.0, 0.0, 0.0)  # m that are added to errors, step by step
SHARP = (0.0005, 0.0005, 0.0002, 0.0, 0.0, 0.0, 0.0)  # and where it starts from outside
_AHEAD = torch.tensor([0.0, 0.003, 0.006, 0.01], dtype=torch.float64)  # m
_SHARES_OF_STEP = torch.tensor([0.0, 0.15, 0.5, 1.0], dtype=torch.float64)
# Where Gauss-Newton starts, in deviations of what is known beside the touches: always the same.
_STARTS = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
_MOVED = 0.001  # m: less is no direction


class Normal(NamedTuple):
    """What is known beside touches: a pose (1, 7), and a precision (1, 6, 6) in its tangent space."""

    center: Tensor
    precision: Tensor


class Told(NamedTuple):
    """What touches say to second order around a pose (7,): of minus the log-likelihood (6,) and (6, 6)."""

    around: Tensor
    slope: Tensor
    information: Tensor


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


def told_by(gap: MeasuresGap, windows: Sequence[Window], known: Normal, before: Tensor | None) -> Told:
    """What windows say around the likeliest pose that Gauss-Newton finds.

    It starts from what is known, and from places around it, at first with errors of millimetres. Where a part
    stands too near, a peg is deep in it, and would be led out of a thin wall on the wrong side; so it starts
    from outside as well, the part farther on in the direction in which the peg last met it.

    Args:
        gap: measures gaps.
        windows: those in which the peg was near the part.
        known: beside them.
        before: (1, 7) where fewer windows placed the part; None for none.
    """
    center, precision = known
    scale = torch.linalg.cholesky(torch.linalg.inv(precision[0]))
    starts = [center, poses.retract(center, _STARTS @ scale.T), *([] if before is None else [before])]
    found = [fitted(gap, windows, torch.cat(starts), known, BLURS)]
    onward = _onward(windows)
    if onward is not None:
        ahead = torch.cat([center, center if before is None else before]).repeat_interleave(len(_AHEAD), 0)
        ahead[:, :3] += _AHEAD.repeat(2)[:, None] * onward
        found.append(fitted(gap, windows, ahead, known, SHARP))
    pose, _ = max(found, key=lambda fit: fit[1])
    slope, information = _pull(gap, windows, pose, 0.0)
    return Told(pose[0], slope[0], information[0])


def fitted(
    gap: MeasuresGap, windows: Sequence[Window], starts: Tensor, known: Normal, blurs: Sequence[float]
) -> tuple[Tensor, float]:
    """The likeliest pose (1, 7) to which Gauss-Newton leads, and its log-probability.

    Args:
        gap: measures gaps.
        windows: those in which the peg was near the part.
        known: beside them.
        starts: (S, 7); half of them are left at each step.
        blurs: metres that are added to errors at each step, 0 in the end.
    """
    center, precision = known
    pose, said = starts, torch.zeros(len(starts))
    for blur in blurs:
        slope, information = _pull(gap, windows, pose, blur)
        pull = (precision @ poses.local(pose, center)[..., None])[..., 0] - slope
        step = torch.linalg.solve(precision + information, pull[..., None])
        # Which corner touches changes on the way: so far and no farther than it gains.
        tried = poses.retract(pose[:, None], _SHARES_OF_STEP[:, None] * step[:, None, :, 0])
        away = poses.local(center, tried.reshape(-1, 7))
        total = -0.5 * ((away @ precision[0]) * away).sum(dim=-1)
        for site, value in _sites(gap, windows, tried.reshape(-1, 7), blur):
            total = total + site.log_prob(value)
        said, farthest = total.reshape(tried.shape[:2]).max(dim=1)
        kept = said.topk(max(1, len(pose) // 2)).indices
        pose = tried[kept, farthest[kept]]
    return pose[:1], float(said.max())


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


def _pull(gap: MeasuresGap, windows: Sequence[Window], pose: Tensor, blur: float) -> tuple[Tensor, Tensor]:
    """Slope (S, 6) and curvature (S, 6, 6) of minus the log-likelihood of all windows at poses (S, 7)."""
    slope, information = pose.new_zeros(len(pose), 6), pose.new_zeros(len(pose), 6, 6)
    for site, value in _sites(gap, windows, pose, blur):
        said = site.quadratic(value)
        slope, information = slope + said.slope, information + said.information
    return slope, information


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
