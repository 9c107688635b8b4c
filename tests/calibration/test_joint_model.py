"""The joint model of a bench is calibrated in part, grasp, arm, clock, sizes, slides and noise.

A failure prints the ranks' mean and spread of every quantity, as in `test_calibration`.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch

from bcppl.distributions.episodes.covariances import segments_of
from bcppl.inference.calibration.ranks import p_value
from tests.calibration.case import DRAWS, gather
from tests.calibration.shared_errors import (
    BENCHES,
    FORCES,
    Bench,
    errors_of,
    quantities,
    round_of,
    simulated,
)
from tests.calibration.test_calibration import BROKEN, SEED, SOUND

ROUNDS = 200


def test_what_is_simulated_has_the_residuals_of_the_likelihood() -> None:
    """Whitened gaps at the truth are standard normal: a wrong sign or a missing error is not."""
    torch.manual_seed(3)
    whitened = []
    while len(whitened) < 6:
        truth, rows = simulated()
        site = Bench().site(truth.pose[None], rows)
        if float(truth.errors[site.bench.slices["the part's place on the table"]].abs().max()) > 0.0:
            continue  # it jumped, and earlier rows had other errors
        gaps = site.gap(site.pose, rows[:, :7])
        moved, columns = (each[0] for each in site._late(gaps, rows))
        place = list(site.bench.delays).index(truth.hypothesis.delay)
        error = gaps.distance[0] + moved[place] + columns[place] @ truth.errors
        error = error + truth.hypothesis.compliance * rows[:, 9]
        factor = torch.from_numpy(segments_of(rows, site._row_errors, (truth.hypothesis,)).factor[0])
        blocks = factor.unflatten(0, (-1, len(FORCES)))[..., : len(FORCES)]
        whitened.append(torch.linalg.solve_triangular(blocks, error.view(-1, len(FORCES), 1), upper=False))
    each = torch.stack(whitened).flatten()
    assert abs(float(each.mean())) < 4.0 / math.sqrt(len(each))
    assert float(each.std()) == pytest.approx(1.0, abs=0.15)


def table(name: str, rounds: int) -> tuple[float, str]:
    """The smallest p-value of any quantity times their number, and all of them in lines."""
    ranked = np.array([each.numpy() for each in gather(partial(round_of, name), rounds, SEED, 2)])
    uniform = math.sqrt(((DRAWS + 1) ** 2 - 1) / 12)
    lines, p = [f"{name}: {rounds} rounds"], []
    for quantity, column in zip(quantities(errors_of()), ranked.T, strict=True):
        p.append(p_value(column, DRAWS))
        mean, spread = column.mean() / DRAWS, column.std() / uniform
        lines.append(f"  {quantity:40} p {p[-1]:7.5f}  mean {mean:.3f}  spread {spread:.2f}")
    return min(1.0, min(p) * len(p)), "\n".join(lines)


@pytest.mark.long
def test_part_and_all_that_touches_share_rank_like_draws() -> None:
    corrected, lines = table("sound", ROUNDS)
    print(f"\n{lines}")
    assert corrected > SOUND, lines


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(BENCHES) - {"sound"}))
def test_mutants_do_not(name: str) -> None:
    corrected, lines = table(name, 60)
    print(f"\n{lines}")
    assert corrected < BROKEN, lines
