"""The hypotheses of what all touches share, after the rows of a probe, for each particle."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl.devices import is_on_host, numbers, on_device_of
from bcppl.distributions.episodes.couples import MeasuresWitness
from bcppl.distributions.episodes.displaced import Lines, lines_at
from bcppl.distributions.episodes.filter.alike import AlikeBranches, begun_alike, filtered_alike
from bcppl.distributions.episodes.filter.branches import Branches, Prior, begun
from bcppl.distributions.episodes.filter.posterior import moments
from bcppl.distributions.episodes.filter.row_errors import Hypothesis, RowErrors, segments_of
from bcppl.distributions.episodes.filter.switching_filter import filtered
from bcppl.distributions.episodes.linear_errors import LinearErrors
from bcppl.distributions.episodes.predicted import PredictedEpisodes
from bcppl.distributions.episodes.prior import nodes_of, prior_of, with_delays
from bcppl.distributions.episodes.regressed import Spread, regressed
from bcppl.distributions.episodes.rows import COLUMNS, EPISODE, FORCE, NOISE, is_cut, last_end
from bcppl.distributions.manifold import FARTHEST, ContactManifold
from bcppl.distributions.parameters import NONNEGATIVE, POSITIVE

_FAR = 4.0  # standard deviations
_ASTRAY, _AWAY = 5.0, 0.001  # standard deviations, and m, beyond both of which a contact is none at a pose
_REMEMBERED = 5  # a window's rows are those that the next one is given


class Linearised(NamedTuple):
    """Hypotheses, and what the shared errors of each particle may be, over which the gap is linear."""

    branches: Branches | AlikeBranches
    errors: Spread


@dataclass(eq=False, repr=False)
class FilteredEpisodes(PredictedEpisodes):
    """What `ContactEpisodes` knows of shared errors and of hypotheses; its arguments are explained there."""

    __caches__ = ("memory",)

    drift: float = field(default=0.00002, metadata=NONNEGATIVE)
    lasting: float = field(default=0.1, metadata=POSITIVE)
    compliance: float = field(default=0.000005, metadata=POSITIVE)
    uncertain: float = field(default=0.5, metadata=POSITIVE)
    varying: float = field(default=0.6, metadata=NONNEGATIVE)
    rough: float = field(default=0.2, metadata=NONNEGATIVE)
    blur: float = field(default=0.0, metadata=NONNEGATIVE)
    bench: LinearErrors = field(default_factory=LinearErrors)
    hypotheses: tuple[Hypothesis, ...] = ()
    memory: dict[bytes, Linearised] = field(default_factory=dict, init=False)
    solids: MeasuresWitness | None = None

    def __post_init__(self) -> None:
        super(ContactManifold, self).__init__(len(self.pose), (self.stamps, COLUMNS))

    def branches(self, rows: Tensor, after: Tensor | None = None) -> Branches | AlikeBranches:
        """The hypotheses after rows (R, COLUMNS), the first of them `after`, where these were seen before."""
        return self._known(rows, after).branches

    def _known(self, rows: Tensor, after: Tensor | None = None) -> Linearised:
        """The hypotheses after rows, and what the shared errors may be by those until the last end.

        They depend on the rows alone, not on how a probe is cut: the evidence of a window is a difference,
        and of what is linear about one thing and then about another it would be any number.
        """
        key = rows.numpy().tobytes()
        if key not in self.memory:
            before, new = self._before(rows, after)
            branches = self._filtered(before.branches, self._prior(0), new, before.errors)
            self.memory[key] = Linearised(branches.of_each, before.errors)
            for old in list(self.memory)[:-_REMEMBERED]:
                del self.memory[old]
        return self.memory[key]

    def _before(self, rows: Tensor, after: Tensor | None) -> tuple[Linearised, Tensor]:
        """What is known before some of the rows, and these: those after `after`, or since the last end.

        Gaps are linear over what the errors may be there: where flat faces meet, and the peg seems to be
        turned otherwise than was assumed, another corner touches.
        """
        place = last_end(rows) if self._regresses else 0
        if after is not None and len(after) > place and not is_cut(rows, len(after)):
            known = self.memory.get(after.numpy().tobytes())
            if known is not None:
                return known, rows[len(after) :]
        if not place:
            prior = self._prior(0)
            start = begun_alike(prior, self.pose) if self._is_alike else begun(prior, len(self.pose))
            return Linearised(start, self._errors_before), rows
        branches = self._known(rows[:place], after).branches
        errors = (on_device_of(each, self.pose) for each in moments(branches.on_host))
        return Linearised(branches, Spread(*errors)), rows[place:]

    @property
    def _regresses(self) -> bool:
        """Whether gaps are fitted over what the errors may be; coarsely they are linear about none."""
        return bool(self.bench.errors) and not self.blur

    @property
    def _is_alike(self) -> bool:
        """Whether all particles have the same errors, and are filtered together on a GPU."""
        return not (self.bench.errors or is_on_host(self.pose))

    @property
    def _errors_before(self) -> Spread:
        """What the shared errors may be before any row."""
        count, (means, variances) = len(self.pose), (self.bench.means, self.bench.variances)
        means, variances = on_device_of(means, self.pose), on_device_of(variances, self.pose)
        return Spread(means.expand(count, -1), torch.diag(variances).expand(count, -1, -1))

    def _variance(self, columns: Tensor, rows: Tensor) -> Tensor:
        """Variances (N, D, R) of gaps a priori, without what the contact's compliance adds."""
        own = rows[:, NOISE] ** 2 + self.blur**2 + self.drift**2 + self.shared**2
        variances = on_device_of(self.bench.variances, columns)
        return on_device_of(own, columns) + (columns**2 * variances).sum(dim=-1)

    @property
    def _every(self) -> tuple[Hypothesis, ...]:
        return with_delays(self.hypotheses or nodes_of(self.compliance, self.uncertain), self.bench)

    @property
    def _few(self) -> tuple[Hypothesis, ...]:
        """Those of an approximation to second order, which needs fewer nodes."""
        return with_delays(self.hypotheses or nodes_of(self.compliance, self.uncertain, 2), self.bench)

    def _prior(self, pose: int) -> Prior:
        """With so many parameters of the pose before the others."""
        return prior_of(self.bench, self._few if pose else self._every, self.outlier, pose)

    def _lines(self, rows: Tensor, errors: Spread) -> Lines:
        """The gaps at rows (R, COLUMNS), linear over what the errors may be."""
        if self._regresses:
            return regressed(self.solids or self.gap, self.pose, rows, self.bench, errors)
        return lines_at(self.gap(self.pose, rows[:, :7]), self.pose, rows, self.bench)

    def _filtered(self, begin: Any, prior: Prior, rows: Tensor, errors: Spread, free: bool = False) -> Any:
        """The hypotheses after rows, the pose `free` to move about `self.pose` or held there.

        The gap is linear over what the shared errors may be.
        """
        if not len(rows):
            return begin
        segments = segments_of(rows, self._row_errors, self._few if free else self._every)
        if isinstance(begin, AlikeBranches):
            distance = self.gap(self.pose, rows[:, :7]).distance
            return filtered_alike(begin, prior, segments, distance, rows[:, FORCE].numpy())
        lines = self._lines(rows, errors)
        if not free:
            return filtered(begin, prior, segments, lines, rows[:, FORCE])
        trust = self._trust(lines, rows) if self.blur else self._not_astray(lines, rows)
        return filtered(begin, prior, segments, lines, rows[:, FORCE], lines.gradient, trust)

    def _not_astray(self, lines: Lines, rows: Tensor) -> Tensor:
        """Factors (N, D, R) of contacts' errors: 0 of pieces that are far off at these poses, 1 of others.

        Where the pose is free to move, a contact that is false may be the first to determine a direction, so
        that it seems to be none: those which are true would then be the outliers.
        """
        segments, branches = segments_of(rows, self._row_errors, self._every), self.branches(rows).on_host
        contact = segments.contact == 1
        first, count = segments.first[contact], (segments.last - segments.first)[contact]
        surprise = (branches.weights[..., None] * branches.squared).sum(axis=1) / count  # (N, pieces)
        away = np.add.reduceat(np.abs(numbers(lines.distance)), segments.first, axis=1)[:, contact] / count
        astray = (surprise > _ASTRAY**2) & (away > _AWAY)
        factors = np.ones((len(astray), len(lines.late), len(rows)))
        for piece in astray.any(axis=0).nonzero()[0]:
            own = slice(first[piece], first[piece] + count[piece])
            factors[astray[:, piece], :, own] = 0.0
        return on_device_of(torch.from_numpy(factors), self.pose)

    @property
    def _row_errors(self) -> RowErrors:
        return RowErrors(self.blur, self.shared, self.drift, self.lasting, self.varying, self.rough)

    def _trust(self, lines: Lines, rows: Tensor) -> Tensor:
        """Factors (N, D, R) of contacts' errors, each by itself: what is far off hardly pulls.

        While errors are taken to be wider than they are, to be led to a mode from afar, no row comes before
        another. An episode counts by the probability that it is no outlier.
        """
        distance, columns = lines.distance[:, None] + lines.moved, lines.columns
        sunk = self.compliance * torch.nan_to_num(rows[:, FORCE])
        variance = self._variance(columns, rows) + (3.0 * sunk) ** 2
        squared = (distance + sunk + columns @ self.bench.means) ** 2 / variance
        inlier = -0.5 * (squared + (2.0 * math.pi * variance).log())
        numbers, episode = rows[:, EPISODE].unique(return_inverse=True)
        excess = distance.new_zeros(*distance.shape[:-1], len(numbers))
        excess.index_add_(-1, episode, inlier + math.log(FARTHEST))
        sure = torch.sigmoid(excess + math.log1p(-self.outlier) - math.log(self.outlier))[..., episode]
        return (sure * (_FAR**2 / squared).clamp(max=1.0)).sqrt()
