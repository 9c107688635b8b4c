"""Bridging: SMC from a proposal to the posterior, for a proposal that is good but not good enough.

The weights of importance sampling are tempered as a likelihood is: between the proposal q and the posterior p
lie the densities q^(1 - e) p^e (Neal, Annealed importance sampling, Statistics and Computing 11, 2001, eq. 3,
with the resampling and the adaptive exponents of `bcppl.inference.filters.tempering`). The closer the
proposal, the fewer exponents; from the prior it is tempering.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.filters.step import Stepped
from bcppl.inference.filters.tempering import (
    Path,
    Rejuvenated,
    Schedule,
    Tempered,
    share_of,
    where_left,
)
from bcppl.inference.kernels import Kernel, Until, until
from bcppl.inference.kernels.kernel import refuse_no_kernel
from bcppl.inference.kernels.rejuvenation import moved_by, shift
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import continuous_addresses
from bcppl.inference.targets import POSTERIOR, FunctionTarget, Target
from bcppl.traces import Program, Trace, assess, generate, propose

# Standard errors by which moves change a mean or a variance: below the first the particles have settled, and
# beyond the second they were no draws of what was moved towards. Draws stay below 4 on all of three axes
# (`tests/inference/kernels/test_shift.py`); more axes and exponents ask for a little more.
SETTLED, SHIFTED = 3.0, 5.0
AWAY, ROUNDS = until(displacement=1.5, most=50), 10  # moves at the posterior


def bridge(start: Callable[[Trace], Tensor], exponent: float) -> Target:
    """The target q^(1 - e) p^e, given the log-density (N,) of q and the exponent e."""
    return FunctionTarget(
        log_density=lambda trace: exponent * trace.log_prob() + (1.0 - exponent) * start(trace)
    )


def bridged(
    program: Program,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    proposal: Program,
    kernel: Kernel,
    *,
    sweeps: int | Until = 3,
    share: float = 0.5,
) -> Stepped:
    """Weighted particles of the posterior by SMC from a proposal, and the record of the run.

    Where all particles begin well inside the posterior, their weights say nothing of what lies outside. So
    they are moved at the posterior until that changes their means and variances no more, and a RuntimeWarning
    states where moves did before.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, of the shape of the sites' events.
        particles: N.
        proposal: `proposal(*args)`, as for `importance_sampling`; latent addresses that it leaves out are
            drawn from the program.
        kernel: moves the particles after each exponent; `hmc` by gradients of the posterior, which its target
            does not depend on. Delayed acceptance has no stages here.
        sweeps: how many moves of every particle after each resampling, or `until(...)`.
        share: exponents keep the conditional effective sample size above this share of the particles.

    Raises:
        InputError: what is given is no kernel, a number is out of range, the proposal samples no address, or
            what `importance_sampling` refuses.
    """
    refuse_no_kernel("bridged", kernel)
    kept = share_of(share)
    if not isinstance(sweeps, Until):
        sweeps = whole_number("bridging is to move the particles in {} sweeps", sweeps)
    proposed = propose(proposal, args, particles)
    if not proposed.choices:
        raise InputError("a proposal for bridging samples no address; temper from the prior instead.")
    trace, _ = generate(program, args, observations, particles, proposed.choices)
    start = _Start(proposal, args, tuple(proposed.choices))
    path = Path(
        lambda trace: trace.log_prob() - start(trace),
        lambda exponent: bridge(start, exponent) if exponent < 1.0 else POSTERIOR,
    )
    resample, shifts = where_left(kept), list[float]()

    def rejuvenation(population: Population, target: Target) -> Rejuvenated:
        population, ancestors = resample(population)
        if ancestors is None:
            return Rejuvenated(population, None, None)
        moved = moved_by(population, kernel, target, sweeps)
        shifts.append(shift(population, moved.population))
        return Rejuvenated(moved.population, ancestors, moved.acceptance, moved.displacement)

    population, info = Tempered(rejuvenation, Schedule(kept)).along(path, Population(trace))
    away = AWAY if continuous_addresses(trace) else sweeps
    for _ in range(ROUNDS):
        before, population = population, moved_by(population, kernel, POSTERIOR, away).population
        shifts.append(shift(before, population))
        if shifts[-1] < SETTLED:
            break
    if (worst := max(shifts)) > SHIFTED:
        warnings.warn(
            f"moves have changed the particles' means or variances by {worst:.1f} standard errors, and would "
            "not if these were draws of what they move towards: the log evidence "
            f"{population.log_evidence:.4g} is off; give a wider proposal, more particles or sweeps.",
            RuntimeWarning,
            stacklevel=2,
        )
    return Stepped(population, info)


@dataclass(frozen=True)
class _Start:
    """The log-density (N,) of a trace's latent values: some from a proposal, the others from the program."""

    proposal: Program
    args: tuple[Any, ...]
    addresses: tuple[str, ...]

    def __call__(self, trace: Trace) -> Tensor:
        values = {address: trace[address] for address in self.addresses}
        others = [address for address in trace.choices if address not in values]
        total = assess(self.proposal, self.args, values, trace.particles)
        return total + trace.log_prob(*others) if others else total
