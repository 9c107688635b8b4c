"""Whether updates and simulation give the densities of a new run at the same values."""

from __future__ import annotations

import torch

from bcppl.distributions.support import masks
from bcppl.errors import InputError
from bcppl.traces.checks.comparing import differing, first_differing, log_probs, rerun
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.trace import Trace
from bcppl.traces.update import update
from bcppl.traces.verbs import constrained


def check_updates(trace: Trace, other: Trace) -> None:
    """Check that a trace misses no dependence of a site on a latent value.

    Every latent value in turn is replaced by another draw; then particles are merged with those before and
    reordered, as kernels do. The log-probability of every site has to be that of a new run at the same
    values. It is not where a site depends on a latent value through something that is no part of it
    (`bcppl.traces.dependence.equality`), such as an object that both runs share and one writes into.

    Args:
        trace: of N particles.
        other: another trace of as many, whose values are put in place of the first one's.

    Raises:
        ProgramError: a log-probability is another.
    """
    _check_late(trace, other)
    particles = trace.particles
    half, reverse = torch.arange(particles) % 2 == 0, torch.arange(particles).flip(0)
    for address, value in other.choices.items():
        moved = update(trace, {address: value}).trace
        _compare(moved, address)
        _compare(moved.where(half, trace)[reverse], address)


def check_simulated(trace: Trace) -> None:
    """Check that sites have the same densities where their values were sampled as where they are given.

    All sites are sampled, those that are observed too, unless one cannot be; the structure stays.

    Raises:
        ProgramError: a log-probability is another (STATE).
    """
    try:
        structure = trace.structure.observations
        simulated, _ = constrained(trace.program, trace.args, trace.particles, structure, {})
    except InputError:
        return
    again = rerun(simulated)
    for address in simulated.addresses:
        if masks(simulated.distributions[address]):
            continue
        sampled, given = simulated.log_prob(address), again.log_prob(address)
        if bool((other := differing(sampled, given)).any()):
            particle = int(other.nonzero()[0])
            raise ProgramError(
                Fault.STATE,
                address,
                f"site {address!r} has log-probability {float(sampled[particle]):.6g} where its value was "
                f"sampled and {float(given[particle]):.6g} where it is given; let `sample` leave nothing "
                "behind.",
            )


def _check_late(trace: Trace, other: Trace) -> None:
    """Check that a trace may be evaluated after the program was run at other values."""
    expected, late = log_probs(trace), rerun(trace)
    late.distributions  # noqa: B018
    rerun(other).distributions  # noqa: B018
    if (where := first_differing(expected, log_probs(late))) is not None:
        raise ProgramError(
            Fault.DEPENDENCE,
            where[0],
            f"site {where[0]!r} has another log-probability where the program was run at other values before "
            "it is evaluated; hold all that its distribution depends on in the distribution, as an attribute "
            "that is made in each run.",
        )


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
