"""Whether a kernel leaves the posterior invariant: exact draws of the joint are moved, and must stay such.

A draw of a program, latent values and data together, is a draw of the latent values from their posterior
given these data. Moved by a kernel that leaves every posterior invariant, it remains a draw of the joint
(Geweke, Getting it right: joint distribution tests of posterior simulators, JASA 99, 2004). Each draw is
compared with itself, by the ranks of its values, so that heavy tails do no harm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import biject_to

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.distributions.support import freedom_of, whole_support
from bcppl.errors import InputError
from bcppl.inference.calibration.joint import Joint
from bcppl.inference.kernels.kernel import Kernel, Move, fitted
from bcppl.inference.population import Population
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Trace, simulate, update
from bcppl.traces.checks.runs import seed as seeded, undisturbed
from bcppl.traces.indexing import broadcast
from bcppl.traces.run import Program

TAUGHT = 300  # draws that the kernel is fitted to, none of which it moves
REPEATED = 100  # draws that are moved twice with the same random numbers
# Of other particles, in unbounded coordinates: so small that no decision of theirs changes.
NUDGE = {torch.float64: 1e-7, torch.float32: 1e-4}
FALSE_ALARM = 1e-6  # probability that a right kernel is refused
NUMBERS = 10  # of a site's values, at most, that are compared

Quantities = Callable[[Trace], Tensor]


class KernelError(InputError):
    """A kernel does not leave the posterior invariant: one sentence that states what showed it."""


class KernelCheck(NamedTuple):
    """What a kernel did that passed.

    Attributes:
        p_value: of the expectation that changed most, times the number of those that changed, at most 1.
        acceptance: the share of proposals that were accepted.
    """

    p_value: float
    acceptance: float


def check_kernel(
    kernel: Kernel,
    program: Program,
    args: tuple[Any, ...] = (),
    observed: Sequence[str] | str = (),
    draws: int = 10_000,
    moves: int = 3,
    seed: int = 0,
) -> KernelCheck:
    """Check that a kernel leaves the posterior of a program invariant, and moves each particle by itself.

        check_kernel(metropolis_hastings(nudge), weighed, (), ["reading"])

    The kernel is fitted to draws that it does not move, and moves once first, in case it tunes itself. Then:
    are the same particles moved in the same way with the same random numbers? is a particle moved in the
    same way where others are a little elsewhere? do the data stay? are the draws, once they have moved, still
    draws of the joint? Every particle has data of its own, so the program is run with nothing observed: name
    latent addresses in the kernel (`drift("mass")`), and let a proposal read data as `trace["reading"]`. The
    random state is the same afterwards as before.

    Not seen are changes of an expectation by less than 0.06 of their standard deviation over draws (with
    10 000 of them; four times as many see half as much), and particles that depend on others through whole
    numbers or the acceptance alone. What a kernel learns is here never learned from what it moves.

    Args:
        kernel: of this program's latent addresses.
        program: samples every site itself.
        args: its arguments.
        observed: the addresses of the data, or one.
        draws: of the joint, 100 or more.
        moves: by which each is moved.
        seed: of the draws and the moves; another one gives a second opinion.

    Raises:
        KernelError: the kernel is wrong, or moves nothing.
        InputError: the program observes something itself, cannot be simulated or does not visit an address,
            or a number is out of range.
    """
    whole_number("a kernel is to be checked with {} draws", draws, least=100)
    whole_number("a kernel is to be checked by {} moves", moves)
    data = Joint(program, args, observed).observed
    seed = whole_number("a kernel is to be checked with the seed {}", seed, least=0)
    with undisturbed(seed):
        taught = simulate(program, args, TAUGHT)
        move = fitted(kernel, Population(taught))
        trace = simulate(program, args, draws)
        _check_alone(move, trace[:REPEATED], moves, data)
        quantities = _quantities(trace, data)
        before, now, accepted = quantities(trace), trace, 0.0
        for _ in range(moves):
            now, taken = move(now, POSTERIOR)
            accepted += float(taken.mean()) / moves
        _check_data(trace, now, data)
    return KernelCheck(check_change(quantities(now) - before), accepted)


def _check_alone(move: Move, trace: Trace, moves: int, data: Sequence[str]) -> None:
    """Check that the same random numbers make the same moves, also where every other particle is nudged."""
    move(trace, POSTERIOR)
    first, again = (_moved(move, trace, moves) for _ in range(2))
    for address, value in first.items():
        if not torch.equal(value, again[address]):
            raise KernelError(
                f"the kernel moves {address!r} otherwise when it is run again with the same random numbers: "
                "it depends on what an earlier move has changed (a global variable, a counter), or on a "
                "generator of its own; take that out."
            )
    for parity in range(2):
        chosen = torch.arange(len(trace)) % 2 == parity
        nudged = _moved(move, update(trace, _nudged(trace, chosen, data)).trace, moves)
        for address, value in first.items():
            if not torch.equal(value[~chosen], nudged[address][~chosen]):
                raise KernelError(
                    f"the kernel moves a particle's {address!r} otherwise when other particles are "
                    "elsewhere: it reads a mean, an extreme or a sum of those that it moves; let it learn "
                    "from others, `metropolis_hastings(proposal, spread_of(...))`."
                )


def _moved(move: Move, trace: Trace, moves: int) -> Mapping[str, Tensor]:
    """The values of a trace after moves with always the same random numbers."""
    seeded(1)
    for _ in range(moves):
        trace, _ = move(trace, POSTERIOR)
    return trace.choices


def _nudged(trace: Trace, chosen: Tensor, data: Sequence[str]) -> dict[str, Tensor]:
    """Real latent values, those of the chosen particles (N,) bool a little off."""
    values = {}
    for address, value in trace.choices.items():
        freedom, support = freedom_of(site := trace.distributions[address]), whole_support(site)
        if address in data or value.dtype not in NUDGE or (freedom is None and support.is_discrete):
            continue
        step = NUDGE[value.dtype]
        if freedom is not None:
            off = poses.retract(value, freedom.embed(value.new_full((len(value), freedom.dimension), step)))
        else:
            free = biject_to(support).inv(value)
            off = biject_to(support)(free + step * (1.0 + free.abs()))
        values[address] = torch.where(broadcast(chosen, value), off, value)
    return values


def _check_data(trace: Trace, now: Trace, data: Sequence[str]) -> None:
    for address in data:
        if not torch.equal(trace[address], now[address]):
            raise KernelError(f"the kernel moves {address!r}, which is observed; name latent addresses.")
    if all(torch.equal(value, now[address]) for address, value in trace.choices.items()):
        raise KernelError("the kernel moves no particle, so nothing is checked; propose shorter steps.")


def check_change(change: Tensor) -> float:
    """Refuse a mean change of (N, K) that is not 0 within its standard error; the p value of the largest."""
    spread = change.std(dim=0)
    moving = spread > 1e-12
    z = change.mean(dim=0)[moving] / (spread[moving] / math.sqrt(len(change)))
    largest = float(z.abs().max()) if len(z) else 0.0
    p_value = min(1.0, math.erfc(largest / math.sqrt(2.0)) * len(z))
    if p_value < FALSE_ALARM:
        raise KernelError(
            f"the kernel does not leave the posterior invariant: over {len(change)} draws an expectation "
            f"changes by {largest:.1f} standard errors; its acceptance needs the density of the reverse "
            "proposal, and of a map the Jacobian."
        )
    return p_value


def _quantities(trace: Trace, data: Sequence[str]) -> Quantities:
    """Functions (N, K) of draws: ranks among those of a trace, their squares, and products of two."""
    latent = [address for address in trace.choices if address not in data]
    ordered = _numbers(trace, latent, data).sort(dim=0).values.T.contiguous()
    own = len(ordered) - sum(site_numbers(trace, address).shape[1] for address in data)
    first, second = torch.triu_indices(own, len(ordered))

    def quantities(now: Trace) -> Tensor:
        values = _numbers(now, latent, data).T.contiguous()
        rank = (torch.searchsorted(ordered, values) + torch.searchsorted(ordered, values, right=True)).T
        share = rank / len(trace) - 1.0
        return torch.cat([share, share[:, first] * share[:, second]], dim=1)

    return quantities


def _numbers(trace: Trace, latent: Sequence[str], data: Sequence[str]) -> Tensor:
    """(N, L): numbers of the latent values, log-densities of the data and of all, and numbers of the data."""
    density = [trace.log_prob(*data), trace.log_prob()] if data else [trace.log_prob()]
    columns = [*(site_numbers(trace, a) for a in latent), torch.stack(density, dim=1)]
    return torch.cat([*columns, *(site_numbers(trace, a) for a in data)], dim=1)


def site_numbers(trace: Trace, address: str) -> Tensor:
    """Numbers (N, D) of a site's values, of a pose its translation and rotation matrix."""
    value = trace[address].to(torch.float64)
    if freedom_of(trace.distributions[address]) is not None:
        value = torch.cat([value[..., :3], poses.rotation_matrix(value).flatten(-2)], dim=-1)
        return value.flatten(1)  # q and -q are one pose
    return value.reshape(len(trace), -1)[:, :NUMBERS]
