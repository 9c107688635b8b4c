"""A check of a program: whether an update of each latent value gives the densities of a new run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces.run import Program
from bcppl.traces.series import Series
from bcppl.traces.trace import Trace
from bcppl.traces.update import update
from bcppl.traces.verbs import generate

# Simulators run for a batch of particles may round otherwise than for others.
TOLERANCE = 1e-6


def check_program(
    program: Program | Series, args: tuple[Any, ...], observations: Mapping[str, Tensor], particles: int = 10
) -> None:
    """Check that a trace misses no dependence of a site on a latent value.

    Every latent value in turn is replaced by another draw; then particles are merged with those before and
    reordered, as kernels do. The log-probability of every site has to be that of a new run at the same
    values. It is not where a site depends on a latent value through something that is no part of it
    (`bcppl.traces.dependence`), such as a global variable, or where a log-probability is random.

    Args:
        program: a Pyro program, or a series, of which `init` is checked.
        args: its arguments.
        observations: values by address; sites that are left out are latent and sampled.
        particles: N.

    Raises:
        InputError: a log-probability is another; names the site and the latent address.
    """
    trace, _ = generate(program, args, observations, particles)
    trace.log_prob()
    other, _ = generate(program, args, observations, particles)
    half, reverse = torch.arange(particles) % 2 == 0, torch.arange(particles).flip(0)
    for address, value in other.choices.items():
        moved = update(trace, {address: value}).trace
        _compare(moved, address)
        _compare(moved.where(half, trace)[reverse], address)


def _compare(trace: Trace, latent: str) -> None:
    again = replace(trace, carried={}, known={})
    for address in trace.addresses:
        updated, expected = trace.log_prob(address), again.log_prob(address)
        if not torch.allclose(updated, expected, rtol=TOLERANCE, atol=TOLERANCE):
            particle = int((updated != expected).nonzero()[0])
            raise InputError(
                f"site {address!r} has log-probability {float(updated[particle]):.6g} after {latent!r} was "
                f"updated and {float(expected[particle]):.6g} in a new run; hold all that its distribution "
                "depends on in the distribution, and make no part of it random."
            )
