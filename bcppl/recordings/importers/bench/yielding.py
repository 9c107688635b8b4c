"""How late a force is relative to a path: by an arm that yields to it as a mass, a damper and a spring.

Where a peg meets a part the force begins at once, and the peg leaves its straight path only as its mass lets
it: after 5 to 10 ms, if it is slow, by less than an arm's encoders resolve. The time at which a path seems to
bend is therefore late by as much (by 4 to 8 ms in the simulations of the bench). So the path is compared with
the one that the measured force itself would make of it: straight, and the response of an arm

    mass e'' + damping e' + stiffness e = force,

less what the structure beyond the encoders yields, which the encoders run ahead by. These five numbers (with
the time) are shared by all contacts and estimated together, under wide priors, by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.signal import lfilter

from bcppl.arrays import Array
from bcppl.recordings.importers.bench.contacts import STEP, Contact

# Medians and standard deviations of lateness (s), of the logarithms of stiffness (N/m), damping (N s/m) and
# mass (kg), of the structure's compliance (m/N), and of the clocks' drift (s/s).
_MEDIANS = np.array([0.0, *np.log([5e3, 300.0, 2.0]), 0.0, 0.0])
_WIDTHS = np.array([0.02, 3.0, 2.5, 1.2, 3e-5, 5e-5])
_STEPS = np.array([0.05, 0.2, 0.2, 0.4, 0.3, 0.3])  # of the search, in those standard deviations
_FARTHEST = np.array([0.6, 1.5, 2.0, 2.5, 6.0, 10.0])
# Where a search may start, in s, N/m, N s/m and kg: an impact makes local minima, milliseconds apart.
_ARMS = ((5e3, 60, 2), (5e3, 300, 2), (5e3, 500, 0.4), (5e4, 500, 2))
_GRID = [(s, *arm) for s in np.arange(-0.008, 0.0105, 0.001) for arm in _ARMS]
_SEARCHES = 4
_WORSE = 4.0  # times the median misfit of contacts: one that is worse is no contact of a rigid part
_FOLDS = 8  # of the jackknife at most
_LEAST = 0.0003  # s: standard deviation below which no clock is claimed to be known
_EVALUATIONS = 40  # of a search


@dataclass(frozen=True)
class Lateness:
    """How late a force's clock is.

    Attributes:
        late: s, at the time `at` (s) on the force's clock.
        spread: its standard deviation, s.
        drift: of the force's clock against the path's, s/s.
        drift_spread: its standard deviation.
        at: s.
        contacts: how many it is estimated from.
    """

    late: float
    spread: float
    drift: float
    drift_spread: float
    at: float
    contacts: int


def fitted(contacts: Sequence[Contact], late: float, *, drifts: bool) -> Lateness:
    """How late the force is, near a value (s).

    The standard deviation is that of least squares with the jackknife's over contacts.
    """
    middle = float(np.mean([each.time for each in contacts]))
    problem = _Problem(late, middle, 6 if drifts else 5)
    best = problem.solved(contacts, problem.starts(contacts))
    while len(contacts) > 2:
        misfits = np.array([np.square(r).mean() for r in problem.residuals(best.x, contacts)])
        worst = int(misfits.argmax())
        if misfits[worst] < _WORSE * np.median(misfits):
            break
        contacts = [each for k, each in enumerate(contacts) if k != worst]
        best = problem.solved(contacts, [best.x, *problem.starts(contacts)])
    rows = sum(r.size for r in problem.residuals(best.x, contacts))
    scale = max(1.0, 2.0 * float(best.cost) / max(rows - 6 - 9 * len(contacts), 1))
    variance = scale * np.diagonal(np.linalg.inv(best.jac.T @ best.jac))
    variance = np.square(_WIDTHS[: problem.size]) * (variance + problem.jackknife(contacts, best.x))
    found = problem.numbers(best.x)
    return Lateness(
        late=late + float(found[0]),
        spread=float(np.sqrt(variance[0] + _LEAST**2)),
        drift=float(found[5]),
        drift_spread=float(np.sqrt(variance[5])) if drifts else 0.0,
        at=middle,
        contacts=len(contacts),
    )


@dataclass(frozen=True)
class _Problem:
    """Least squares over the `size` first of the six numbers, each in standard deviations from its median."""

    late: float
    middle: float
    size: int

    def numbers(self, x: Array) -> Array:
        """All six, in SI; those that are not sought at their medians."""
        return _MEDIANS + _WIDTHS * np.pad(x, (0, 6 - self.size))

    def starts(self, contacts: Sequence[Contact]) -> list[Array]:
        each = [np.array([s, *np.log([k, d, m]), 0.0, 0.0]) for s, k, d, m in _GRID]
        each = [((start - _MEDIANS) / _WIDTHS)[: self.size] for start in each]
        costs = [sum(float(np.square(r).sum()) for r in self.residuals(x, contacts)) for x in each]
        return [each[k] for k in np.argsort(costs)[:_SEARCHES]]

    def residuals(self, x: Array, contacts: Sequence[Contact]) -> list[Array]:
        late, *logarithms, compliance, drift = self.numbers(x)
        stiffness, damping, mass = np.exp(logarithms)
        numerator, denominator = _discrete(mass, damping, stiffness)
        left = []
        for each in contacts:
            moved = lfilter(numerator, denominator, each.force, axis=0) - compliance * each.force
            at = each.path_times + self.late + late + drift * (each.time - self.middle)
            columns = [np.interp(at, each.force_times, c, left=0.0) for c in moved.T]
            left.append(each.unexplained(np.stack(columns, axis=1)))
        return left

    def solved(self, contacts: Sequence[Contact], starts: Sequence[Array]) -> OptimizeResult:
        def left(x: Array) -> Array:
            return np.concatenate([*(r.ravel() for r in self.residuals(x, contacts)), x])

        bound = _FARTHEST[: self.size]
        scale = _STEPS[: self.size]
        tried = [
            least_squares(
                left,
                np.clip(start, -0.99 * bound, 0.99 * bound),
                bounds=(-bound, bound),
                x_scale=scale,
                diff_step=[1e-5] * self.size,
                max_nfev=_EVALUATIONS,
            )
            for start in starts
        ]
        return min(tried, key=lambda each: float(each.cost))

    def jackknife(self, contacts: Sequence[Contact], x: Array) -> Array:
        """Variances (size,) over contacts, of which a part is left out in turn."""
        folds = min(len(contacts), _FOLDS)
        if folds < 2:
            return np.zeros(self.size)
        each = [
            self.solved([c for k, c in enumerate(contacts) if k % folds != fold], [x]).x
            for fold in range(folds)
        ]
        return np.asarray((folds - 1) * np.var(each, axis=0))


def _discrete(mass: float, damping: float, stiffness: float) -> tuple[Array, Array]:
    """1 / (mass s^2 + damping s + stiffness) as a filter at `STEP`, by the bilinear transformation."""
    twice = 2.0 / STEP
    inertial, viscous = mass * twice**2, damping * twice
    first = inertial + viscous + stiffness
    rest = [2.0 * (stiffness - inertial) / first, (inertial - viscous + stiffness) / first]
    return np.array([1.0, 2.0, 1.0]) / first, np.array([1.0, *rest])
