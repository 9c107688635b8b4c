"""What a calibration gives: p-values, coverage, the data-averaged posterior, and what they speak for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bcppl.arrays import Array, Indices
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.inference.calibration.quantities import DENSITY, DISTANCE
from bcppl.inference.calibration.ranks import p_value
from bcppl.inference.calibration.rounds import Arrays


class Averaged(NamedTuple):
    """The data-averaged posterior of a coordinate beside its prior: they are one distribution.

    Attributes:
        shift: of its mean from the prior's, in standard deviations of the prior.
        shift_z: the same in standard errors.
        spread: its standard deviation over the prior's.
        spread_z: the difference of the two second moments in standard errors.
    """

    shift: float
    shift_z: float
    spread: float
    spread_z: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """The ranks of R truths among L posterior draws each; print it for a table.

    Attributes:
        names: of the Q test quantities: the C coordinates first.
        ranks: (R, Q) from 0 to L.
        posterior_draws: L.
        truth: (R, C) coordinates of the truths.
        posterior: (R, L, C) those of the posterior draws.
        effective_sample_sizes: (R,) of the populations.
    """

    names: tuple[str, ...]
    ranks: Indices
    posterior_draws: int
    truth: Array
    posterior: Array
    effective_sample_sizes: Array

    @classmethod
    def of_rounds(cls, rounds: Sequence[Arrays], posterior_draws: int) -> Calibration:
        """The calibration of some rounds.

        Raises:
            InputError: they are of different test quantities.
        """
        names = tuple(str(name) for name in rounds[0]["names"])
        for number, one in enumerate(rounds):
            if tuple(map(str, one["names"])) != names:
                raise InputError(
                    f"round {number} has the quantities {', '.join(map(str, one['names']))}, round 0 has "
                    f"{', '.join(names)}; calibrate a program whose latent addresses are always the same."
                )
        each = [np.stack([one[name] for one in rounds]) for name in ("ranks", "truth", "posterior")]
        sizes = np.stack([one["effective_sample_size"] for one in rounds])
        return cls(names, each[0], posterior_draws, each[1], each[2], sizes)

    def __len__(self) -> int:
        return len(self.ranks)

    @cached_property
    def p_values(self) -> dict[str, float]:
        """Of uniform ranks, by test quantity: Saeilynoja et al. 2022. Each by itself; see `p_value`."""
        return {name: p_value(self.ranks[:, k], self.posterior_draws) for k, name in enumerate(self.names)}

    @property
    def p_value(self) -> float:
        """Of all quantities together: the smallest p-value times their number (Bonferroni), at most 1."""
        return min(1.0, len(self.names) * min(self.p_values.values()))

    def levels(self, quantity: str) -> Array:
        """The truths' levels (R,) in (0, 1) in a test quantity: uniform for a calibrated inference.

        Raises:
            InputError: there is no such quantity.
        """
        if quantity not in self.names:
            raise InputError(f"there is no quantity {quantity!r}; there are {', '.join(self.names)}.")
        ranked = self.ranks[:, self.names.index(quantity)]
        return np.asarray((ranked + 0.5) / (self.posterior_draws + 1.0))

    def coverage(self, quantity: str, masses: Sequence[float] = (0.5, 0.9)) -> Array:
        """The share of truths within the central credible interval of each mass, in a test quantity.

        Of "log density" within the region of highest density, and of "distance" within TARP's ball around
        the reference point (expected coverage: Lemos et al., Sampling-based accuracy testing of posterior
        estimators for general inference, ICML 2023).

        Raises:
            InputError: there is no such quantity.
        """
        levels, half = self.levels(quantity), 0.5 / (self.posterior_draws + 1.0)
        shares = []
        for mass in masses:
            low, high = 0.5 - 0.5 * mass, 0.5 + 0.5 * mass
            if quantity in (DENSITY, DISTANCE):
                low, high = (1.0 - mass, 1.0) if quantity == DENSITY else (0.0, mass)
            # A rank is known to lie between two draws, and counts by the share of that range.
            within = np.minimum(high, levels + half) - np.maximum(low, levels - half)
            shares.append(np.mean(within.clip(min=0.0)) / (2.0 * half))
        return np.array(shares)

    @cached_property
    def averaged(self) -> dict[str, Averaged]:
        """The data-averaged posterior of every coordinate beside the prior.

        Each truth is compared with the posterior of its own data, so that differences between truths do not
        count as errors.
        """
        centre, sizes = self.truth.mean(axis=0), self.truth.std(axis=0)
        shifts = (self.posterior - centre).mean(axis=1) - (self.truth - centre)
        squares = ((self.posterior - centre) ** 2).mean(axis=1) - (self.truth - centre) ** 2
        spreads = self.posterior.reshape(-1, len(centre)).std(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            columns = shifts.mean(axis=0) / sizes, _z(shifts), spreads / sizes, _z(squares)
        return {
            name: Averaged(*(float(column[k]) for column in columns))
            for k, name in enumerate(self.names[: len(centre)])
        }

    def __str__(self) -> str:
        """The quantities, one to a line, with their p-values and what their ranks speak for."""
        uniform = math.sqrt(((self.posterior_draws + 1) ** 2 - 1) / 12)
        width = max(len(name) for name in (*self.names, "quantity"))
        lines = [f"{'quantity':{width}}  {'p':>7} {'mean':>6} {'spread':>6} {'50 %':>6} {'90 %':>6}"]
        for k, name in enumerate(self.names):
            mean, spread = self.ranks[:, k].mean() / self.posterior_draws, self.ranks[:, k].std() / uniform
            half, most = self.coverage(name)
            numbers = f"{self.p_values[name]:7.5f} {mean:6.3f} {spread:6.2f} {half:6.3f} {most:6.3f}"
            comment = _comment(self.p_values[name] * len(self.names), mean, spread)
            lines.append(f"{name:{width}}  {numbers}{comment}")
        lines.append(
            f"{len(self)} draws, {np.median(self.effective_sample_sizes):.0f} effective particles (median); "
            f"all quantities together: p {self.p_value:.3g}"
        )
        return "\n".join(lines)


def _z(differences: npt.NDArray[np.float64]) -> Array:
    """The mean of differences (R, C) in its standard errors."""
    error = (
        differences.std(axis=0, ddof=1) / math.sqrt(len(differences)) if len(differences) > 1 else math.nan
    )
    return np.asarray(differences.mean(axis=0) / error)


def _comment(corrected: float, mean: float, spread: float) -> str:
    """What ranks that are not uniform look like: at both ends, in the middle, or to one side."""
    if corrected >= 0.01:
        return ""
    if abs(mean - 0.5) > 0.5 * abs(spread - 1.0):
        return "  truths above the posterior" if mean > 0.5 else "  truths below the posterior"
    return "  posterior too narrow" if spread > 1.0 else "  posterior too wide"
