"""Objectives of training, functions without arguments: each call draws again and gives a loss with gradients.

    forward_kl       -log q(latents | observations) over joint draws of a program: for all observations
    evidence_bound   minus the evidence lower bound of one set of observations

A loss of your own is any such function; `bcppl.traces.gradients` is what attaches it to the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import address_list, whole_number
from bcppl.errors import InputError
from bcppl.inference.learning.amortised import Amortised
from bcppl.traces import Trace, assess, generate, gradients, simulate
from bcppl.traces.differentiation.graph import carries
from bcppl.traces.run import Program

Objective = Callable[[], Tensor]


def forward_kl(
    proposal: Amortised,
    program: Program,
    args: tuple[Any, ...] | Callable[[], tuple[Any, ...]],
    observed: Collection[str] | str,
    *,
    batch: int = 64,
) -> Objective:
    """The objective of inference compilation: the mean of -log q(latents | observations) over joint draws.

    It is, up to the entropy of the program, the Kullback-Leibler divergence from the posterior to the
    proposal, averaged over the observations that the program predicts: smallest where the proposal is the
    posterior, and large where it misses a part of it (Le, Baydin and Wood, Inference compilation and
    universal probabilistic programming, AISTATS 2017, eq. 3). No gradient of the program is needed, so its
    likelihoods may be simulators.

    Args:
        proposal: samples all or some of the latent addresses.
        program: simulated forward, its observed sites included.
        args: its arguments, or a function that draws them.
        observed: the addresses that are observed when the proposal is used, or one.
        batch: joint draws for each evaluation.

    Raises:
        InputError: (when it is evaluated) an observed address is never visited, or the proposal samples one
            that is not a latent address of the program.
    """
    batch = whole_number("forward_kl is asked for batches of {} draws", batch)
    data, asked = address_list(observed), list[str]()

    def loss() -> Tensor:
        drawn = args() if callable(args) else args
        joint = simulate(program, drawn, batch)
        for address in data:
            if address not in joint:
                raise InputError(
                    f"a proposal is to be trained on {address!r}, which the program never visits or observes "
                    f"itself; it samples {', '.join(joint.choices) or 'nothing'}."
                )
        seen = {address: joint[address] for address in data}

        def guide(_: Trace) -> None:
            proposal.guide(seen, *drawn)

        latent = {a: v for a, v in joint.choices.items() if a not in seen}
        if not asked:
            asked.extend(_sampled(guide, joint, latent))
        with gradients():
            return -assess(guide, (joint,), {a: latent[a] for a in asked}, batch).mean()

    return loss


def _sampled(guide: Program, joint: Trace, latent: Mapping[str, Tensor]) -> list[str]:
    """The addresses that a proposal samples."""
    addresses = list(simulate(guide, (joint,), joint.particles).choices)
    for address in addresses:
        if address not in latent:
            raise InputError(
                f"a proposal that is to be trained samples {address!r}, which is no latent address of the "
                f"program; latent are {', '.join(latent) or 'none'}."
            )
    if not addresses:
        raise InputError("a proposal that is to be trained samples nothing; sample at latent addresses.")
    return addresses


def evidence_bound(
    proposal: Program,
    program: Program,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    *,
    samples: int = 1,
    batch: int = 64,
) -> Objective:
    """Minus the evidence lower bound of a program for one set of observations.

    The bound is the mean of the log of the mean of K importance weights: with K = 1 that of variational Bayes
    (Kingma and Welling, Auto-encoding variational Bayes, ICLR 2014), with more that of Burda, Grosse and
    Salakhutdinov (Importance weighted autoencoders, ICLR 2016, eq. 8), which is tighter. It is maximised with
    respect to the parameters of the proposal, and to those of the program where it has some. Draws are
    reparameterised, so the program and its likelihoods are differentiated.

    Args:
        proposal: `proposal(*args)`, such as `amortised.given(observations)`; it samples all latent addresses
            from reparameterised distributions.
        program: that is approximated.
        args: its arguments.
        observations: values by address, of the shape of the sites' events.
        samples: K, importance samples within the logarithm.
        batch: of such terms in each evaluation.

    Raises:
        InputError: (when it is evaluated) the proposal samples no latent address, leaves one out, or samples
            one from a distribution without reparameterised draws; or the program cuts the gradient.
    """
    samples = whole_number("evidence_bound is asked for {} samples within the logarithm", samples)
    batch = whole_number("evidence_bound is asked for batches of {} terms", batch)
    count = samples * batch

    def loss() -> Tensor:
        with gradients():
            proposed = simulate(proposal, args, count)
            for address, site in proposed.distributions.items():
                if not proposed[address].requires_grad and carries(site):
                    raise InputError(
                        f"the evidence bound cannot be differentiated at {address!r}: its draws from a "
                        f"{type(site).__name__} are not reparameterised; train the proposal by forward_kl."
                    )
            trace, log_weights = generate(program, args, observations, count, proposed.choices)
            left_out = [address for address in trace.choices if address not in proposed.choices]
            if left_out:
                raise InputError(
                    f"the proposal of an evidence bound leaves out the latent address {left_out[0]!r}; "
                    "sample it too."
                )
            ratio = (log_weights - proposed.log_prob()).reshape(batch, samples)
            return math.log(samples) - torch.logsumexp(ratio, dim=1).mean()

    return loss
