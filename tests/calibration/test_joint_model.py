"""The joint model of a bench is calibrated in part, grasp, arm, clock, sizes, slides and noise.

A failure prints the ranks' mean and spread of every quantity, as in `test_calibration`.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from bcppl.distributions.episodes import Grasp
from bcppl.distributions.episodes.displaced import lines_at
from bcppl.distributions.episodes.rows import FORCE
from bcppl.inference.calibration.ranks import p_value
from tests.calibration.case import DRAWS, gather
from tests.calibration.shared_errors import (
    BENCHES,
    FORCES,
    SLIPS,
    SOLIDS,
    Bench,
    errors_of,
    quantities,
    rank_among_alike,
    round_of,
    simulated,
    without,
)
from tests.calibration.test_calibration import BROKEN, SEED, SOUND
from tests.distributions.touches.episode_errors import factors

ROUNDS, FEWER = 200, 120


@pytest.mark.long
def test_what_is_simulated_has_the_residuals_of_the_likelihood() -> None:
    """Whitened gaps at the truth are standard normal, and are not where an error is left out.

    But for where another corner touches than the one that the likelihood is linear at: so it is the median.
    """
    torch.manual_seed(3)
    whitened: dict[str, list[torch.Tensor]] = {}
    for _ in range(8):
        truth, rows = simulated(solids=True)
        site = Bench().site(truth.pose[None], rows)
        lines = lines_at(site.gap(site.pose, rows[:, :7]), site.pose, rows, site.bench)
        moved, columns = lines.moved[0], lines.columns[0]
        place = list(site.bench.delays).index(truth.hypothesis.delay)
        apart = lines.distance[0] + moved[place] + truth.hypothesis.compliance * rows[:, FORCE]
        factor = factors(rows, site._row_errors, truth.hypothesis)
        blocks = factor.unflatten(0, (-1, len(FORCES)))[..., : len(FORCES)]
        for left_out, parameters in {"nothing": slice(0, 0), **site.bench.slices}.items():
            errors = truth.errors.clone()
            errors[parameters] = 0.0
            error = (apart + columns[place] @ errors).view(-1, len(FORCES), 1)
            own = torch.linalg.solve_triangular(blocks, error, upper=False).flatten()
            whitened.setdefault(left_out, []).append(own)
    medians = {name: float(torch.cat(each).abs().median()) for name, each in whitened.items()}
    assert medians["nothing"] == pytest.approx(0.6745, rel=0.15)
    for error in errors_of()[:3]:
        assert medians[error.name] > 1.5 * medians["nothing"], error.name


@pytest.mark.long
def test_likelihoods_are_those_of_what_is_simulated() -> None:
    """Without any inference: the truth ranks like any pose that could be exchanged with it."""
    found = kstest([rank_among_alike(seed) for seed in range(40)], "uniform").pvalue
    wrong = kstest([rank_among_alike(seed, without(Grasp)) for seed in range(40)], "uniform").pvalue
    assert found > 0.01 and wrong < 1e-4, (found, wrong)


def table(name: str, rounds: int) -> tuple[float, float, str]:
    """The smallest p-value of any quantity times their number, the largest spread, and all in lines."""
    ranked = np.array([each.numpy() for each in gather(partial(round_of, name), rounds, SEED, 2)])
    uniform = math.sqrt(((DRAWS + 1) ** 2 - 1) / 12)
    lines, p, spreads = [f"{name}: {rounds} rounds"], [], []
    for quantity, column in zip(quantities(errors_of()), ranked.T, strict=True):
        p.append(p_value(column, DRAWS))
        mean, spread = column.mean() / DRAWS, column.std() / uniform
        spreads.append(spread)
        lines.append(f"  {quantity:40} p {p[-1]:7.5f}  mean {mean:.3f}  spread {spread:.2f}")
    return min(1.0, min(p) * len(p)), max(spreads), "\n".join(lines)


@pytest.mark.long
def test_part_and_all_that_touches_share_rank_like_draws() -> None:
    corrected, _, lines = table("sound", ROUNDS)
    print(f"\n{lines}")
    assert corrected > SOUND, lines


@pytest.mark.long
@pytest.mark.parametrize("world", [SLIPS, SOLIDS])
def test_what_is_approximated_costs_little(world: str) -> None:
    """A slip that surprises no touch is not allowed for; where errors are large another corner touches."""
    _, spread, lines = table(world, FEWER)
    print(f"\n{lines}")
    assert spread < 1.2, lines


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(BENCHES) - {"sound"}))
def test_mutants_do_not(name: str) -> None:
    corrected, _, lines = table(name, 30)
    print(f"\n{lines}")
    assert corrected < BROKEN, lines
