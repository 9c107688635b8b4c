"""The kernels of `exact.py` by name, and why some are biased there."""

from __future__ import annotations

import math
from collections.abc import Callable

from kernel_table import even, near, reflected, walk

from bcppl.inference import tempered, waste_free_moves
from bcppl.inference.filters.tempering import Tempered
from bcppl.inference.kernels import (
    Kernel,
    cycle,
    delayed_acceptance,
    hmc,
    metropolis_hastings,
    mixture,
    student_t,
    until,
)
from bcppl.inference.proposals import differential_evolution, independent


def swept(kernel: Kernel, sweeps: int, dimension: int) -> Tempered:
    """Tempering with so many sweeps for each six axes: a random walk takes of the order of D."""
    return tempered(kernel, sweeps=sweeps * math.ceil(dimension / 6))


def waste_free(dimension: int, count: int) -> Tempered:
    """A fifth of the particles each start a chain of five states."""
    return tempered(rejuvenation=waste_free_moves(even("x"), count // 5))


# By name, a step for a problem of so many axes and so many particles.
KERNELS: dict[str, Callable[[int, int], Tempered]] = {
    "drift": lambda d, n: swept(even("x"), 5, d),
    "drift, many scales": lambda d, n: swept(walk("x"), 8, d),
    "drift until displaced": lambda d, n: tempered(walk("x"), sweeps=until(displacement=0.5)),
    "drift until displaced by 1.5": lambda d, n: tempered(walk("x"), sweeps=until(displacement=1.5)),
    "independent": lambda d, n: tempered(metropolis_hastings(independent("x"))),
    "independent, 1 normal": lambda d, n: tempered(near("x", 1)),
    "independent, 1 normal, less wide": lambda d, n: tempered(
        metropolis_hastings(independent("x", 1, inflation=1.05 ** min(1.0, 6.0 / d)))
    ),
    "mixture drift, independent": lambda d, n: swept(mixture([even("x"), near("x", 1)]), 3, d),
    "mixture until displaced": lambda d, n: tempered(
        mixture([walk("x"), metropolis_hastings(independent("x"))]), sweeps=until(displacement=0.5)
    ),
    "cycle drift, independent": lambda d, n: swept(cycle(even("x"), near("x", 1)), 2, d),
    "differential evolution": lambda d, n: swept(metropolis_hastings(differential_evolution("x")), 5, d),
    "differential evolution, 20 sweeps": lambda d, n: swept(
        metropolis_hastings(differential_evolution("x")), 20, d
    ),
    "involutive": lambda d, n: swept(reflected("x"), 5, d),
    "involutive, 20 sweeps": lambda d, n: swept(reflected("x"), 20, d),
    "delayed acceptance": lambda d, n: swept(delayed_acceptance(even("x"), surrogate=student_t("x")), 5, d),
    "hmc": lambda d, n: tempered(hmc("x")),
    "hmc, always moved": lambda d, n: tempered(hmc("x"), always_move=True),
    "waste-free": waste_free,
}

UNTIL = (
    "particles stop while they still correlate with where they began, by about 0.75, and all at a sweep that "
    "depends on them; repeat the moves, or ask for a larger displacement, as `drift until displaced by 1.5`"
)
FEW = (
    "exponents and resampling that depend on the particles leave a bias of order 1/N (hmc, D = 6: -.13 +- "
    ".05 at 75, -.012 +- .013 at 1000); give more particles"
)
UNLEARNED = (
    "D (D + 3) / 2 means and covariances are learnt from half of the particles, 500 for 1325 at D = 50; give "
    "10,000 there, or use hmc"
)
WIDE = (
    "1.05 times as wide along each of 50 axes is 11 times the volume: near the mode hardly any moves; give "
    "an inflation nearer to 1 where there are many to learn from, see that less wide"
)
# Why a kernel may be biased here, by name.
REASONS = {
    "drift until displaced": UNTIL,
    "mixture until displaced": UNTIL,
    "differential evolution": "five sweeps are few, see that with 20",
    "involutive": "five sweeps of steps of one size are few, see that with 20",
    "hmc": FEW,
    "hmc, always moved": FEW,
    "waste-free": "five states of a random walk hardly leave where they began; give fewer, longer chains",
}
