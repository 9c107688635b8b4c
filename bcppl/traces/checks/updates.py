"""Whether an update of each latent value gives the densities of a new run."""

from __future__ import annotations

import torch

from bcppl.traces.checks.comparing import differing, log_probs, rerun
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.trace import Trace
from bcppl.traces.update import update


def check_updates(trace: Trace, other: Trace) -> None:
    """Check that a trace misses no dependence of a site on a latent value.

    Every latent value in turn is replaced by another draw; then particles are merged with those before and
    reordered, as kernels do. The log-probability of every site has to be that of a new run at the same
    values. It is not where a site depends on a latent value through something that is no part of it
    (`bcppl.traces.dependence`), such as an object that both runs share and one writes into.

    Args:
        trace: of N particles.
        other: another trace of as many, whose values are put in place of the first one's.

    Raises:
        ProgramError: a log-probability is another.
    """
    log_probs(trace)
    particles = trace.particles
    half, reverse = torch.arange(particles) % 2 == 0, torch.arange(particles).flip(0)
    for address, value in other.choices.items():
        moved = update(trace, {address: value}).trace
        _compare(moved, address)
        _compare(moved.where(half, trace)[reverse], address)


def _compare(trace: Trace, latent: str) -> None:
    updated = log_probs(trace)
    for address, expected in log_probs(rerun(trace)).items():
        if bool((other := differing(updated[address], expected)).any()):
            particle = int(other.nonzero()[0])
            raise ProgramError(
                Fault.DEPENDENCE,
                address,
                f"site {address!r} has log-probability {float(updated[address][particle]):.6g} after "
                f"{latent!r} was updated and {float(expected[particle]):.6g} in a new run; hold all that its "
                "distribution depends on in the distribution, as an attribute that is made in each run.",
            )
