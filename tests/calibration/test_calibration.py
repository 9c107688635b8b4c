"""Inference is calibrated: the truth's rank among posterior draws is uniform, and broken inference shows it.

A failure names the quantity and shows its ranks. Ranks heaped at both ends (`spread` above 1): particles
are too few, too alike, or too sure; heaped in the middle (below 1): they are not sure enough; to one side
(`mean` off 0.5): they lie beside the truth. Poor sampling fails like a bug ("never moved"), and also where it
shows in nothing else: a six-axis touch with 8 moves after each resampling kept 75 distinct particles of 75,
and failed by spreads of 1.05 to 1.12 on every axis, for they were still near the ones they were copied from.
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.stats import binomtest

from bcppl.inference.calibration.ranks import p_value, ranks
from tests.calibration.case import DRAWS, gather
from tests.calibration.mutants import CASES, MUTANTS, case_of, covered, rank

SEED, ROUNDS = 1804_06788, 300
# Of the smallest p-value times the number of quantities (Bonferroni); the last for few rounds.
SOUND, BROKEN, LOOSE = 0.01, 0.005, 0.001


class Ranked(NamedTuple):
    """What came of some rounds: p-values by quantity, and the table to print."""

    p: dict[str, float]
    table: str

    @property
    def corrected(self) -> float:
        """Bonferroni's."""
        return min(1.0, min(self.p.values()) * len(self.p))


def ranked(name: str, mutant: str | None, rounds: int, processes: int = 2) -> Ranked:
    begun = time.perf_counter()
    drawn = gather(partial(rank, name, mutant), rounds, SEED, processes)
    found = np.array([one.ranks.numpy() for one in drawn])
    p = {q: p_value(column, DRAWS) for q, column in zip(case_of(name).quantities, found.T, strict=True)}
    uniform = math.sqrt(((DRAWS + 1) ** 2 - 1) / 12)
    distinct = np.median([one.distinct for one in drawn])
    lines = [
        f"{name}, {mutant or 'sound'}: {rounds} rounds in {time.perf_counter() - begun:.0f} s, "
        f"{distinct:.0f} distinct particles (median)"
    ]
    for (quantity, value), column in zip(p.items(), found.T, strict=True):
        mean, spread = column.mean() / DRAWS, column.std() / uniform
        lines.append(f"  {quantity:15} p {value:7.5f}  mean {mean:.3f}  spread {spread:.2f}")
    return Ranked(p, "\n".join(lines))


# ---- the test of uniformity itself


def test_p_values_of_uniform_ranks_are_uniform_and_of_others_small() -> None:
    generator = np.random.default_rng(1)
    uniform = [p_value(generator.integers(0, DRAWS + 1, 100), DRAWS) for _ in range(200)]
    assert 0.01 < np.mean(np.array(uniform) < 0.05) < 0.1
    assert np.quantile(uniform, 0.5) == pytest.approx(0.5, abs=0.11)
    for shape in ((1.0, 2.0), (0.5, 0.5), (2.0, 2.0)):
        others = np.floor(generator.beta(*shape, 300) * (DRAWS + 1)).astype(np.int64)
        assert p_value(others, DRAWS) < 1e-3


def test_ranks_count_what_lies_below_and_break_ties_at_random() -> None:
    torch.manual_seed(0)
    draws = torch.tensor([[0.0, 5.0], [1.0, 5.0], [3.0, 5.0]])
    many = torch.stack([ranks(torch.tensor([2.0, 5.0]), draws) for _ in range(2000)])
    assert bool((many[:, 0] == 2).all())
    shares = np.bincount(many[:, 1].numpy(), minlength=4) / 2000
    assert shares == pytest.approx([0.25] * 4, abs=0.04)


# ---- few rounds, with a loose bound, in the ordinary tests


@pytest.mark.long
def test_a_few_rounds_are_calibrated_and_a_flipped_sign_is_not() -> None:
    assert ranked("depth, quick", None, 4, processes=1).corrected > LOOSE
    assert ranked("depth, quick", "sign flipped", 3, processes=1).corrected < LOOSE


# ---- the long tests


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(CASES) - {"depth, quick"}))
def test_the_truth_ranks_like_a_draw(name: str) -> None:
    found = ranked(name, None, 60 if name == "depth, aligned" else ROUNDS)
    print(f"\n{found.table}")
    assert found.corrected > SOUND, found.table


# The draws are the first ones of the sound runs: so many suffice.
FAILING = [
    ("depth, planar", "sign flipped", 30),
    ("touch", "sign flipped", 16),
    ("depth, six axes", "Jacobian of rotations dropped", ROUNDS),
    ("depth, upright", "noise 1.5 times as wide", 150),
    ("depth, aligned", "reverse move left out", 16),
    ("depth, planar", "reverse move left out", 20),
    ("depth, planar", "fitted on the particle it moves", 100),
    ("depth, planar", "never moved", 20),
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "mutant", "rounds"), FAILING)
def test_mutants_do_not(name: str, mutant: str, rounds: int) -> None:
    found = ranked(name, mutant, rounds)
    print(f"\n{found.table}")
    assert found.corrected < BROKEN, found.table


def test_every_mutant_is_tried() -> None:
    assert {mutant for _, mutant, _ in FAILING} == set(MUTANTS)


@pytest.mark.long
def test_regions_of_the_chamfer_surrogate_hold_the_truth_about_as_often_as_they_say() -> None:
    """A surrogate's posterior is none: its regions are counted, and only gross errors are refused."""
    held = np.array(gather(covered, ROUNDS, SEED, 2))
    lines, shares = [], {}
    for mass, inside in zip((0.5, 0.9), held.T, strict=True):
        count = int(inside.sum())
        interval = binomtest(count, len(inside)).proportion_ci(0.95, method="wilson")
        shares[mass] = count / len(inside)
        lines.append(
            f"  {mass:.0%}: {count} of {len(inside)}, 95 % interval {interval.low:.2f} to {interval.high:.2f}"
        )
    print("\n" + "\n".join(["Chamfer surrogate, one press: regions that hold the truth", *lines]))
    assert 0.25 < shares[0.5] < 0.9
    assert shares[0.9] > 0.7
