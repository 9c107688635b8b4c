"""Whether a move of strata leaves the posterior over structures invariant, from exact draws of the joint.

As `bcppl.inference.calibration.check_kernel` does for one structure (Geweke, Getting it right: joint
distribution tests of posterior simulators, JASA 99, 2004): draws of structure, latent values and data
together, moved, must remain such draws. Each is compared with itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.calibration.kernel_check import KernelCheck, KernelError, check_change, site_numbers
from bcppl.inference.structures.generation import sample_strata
from bcppl.inference.structures.moves import StrataMove, refuse_no_move
from bcppl.inference.structures.strata import Strata
from bcppl.inference.targets import POSTERIOR
from bcppl.traces.checks.runs import undisturbed
from bcppl.traces.run import Program

MOST = 20  # structures whose probabilities are compared, the most frequent ones


def check_move(
    move: StrataMove,
    program: Program,
    args: tuple[Any, ...] = (),
    observed: Sequence[str] = (),
    draws: int = 10_000,
    moves: int = 3,
    seed: int = 0,
) -> KernelCheck:
    """Check that a move of strata leaves the posterior of a program of several structures invariant.

        check_move(jump(Jump(more, fewer, split, merge)), summed, (), ["y"])

    Every draw has data of its own, so the program is run with nothing observed. Compared are the structures'
    probabilities, the densities of the data and of all, the values that all structures have, and products of
    these. A proposal that is fitted (`within`) learns from the other half of what is moved. Not seen is what
    `check_kernel` does not see, and a particle's dependence on others. The random state is the same
    afterwards as before.

    Args:
        move: of strata (`jump`, `within`, `in_turn`).
        program: samples every site itself.
        args: its arguments.
        observed: the addresses of the data, which all structures have.
        draws: of the joint, 100 or more.
        moves: by which each is moved.
        seed: of the draws and the moves; another one gives a second opinion.

    Returns:
        KernelCheck: the p value of what changed most, and the share of proposals that were accepted.

    Raises:
        KernelError: the move does not leave the posterior invariant, moves the data, or moves nothing.
        InputError: what is given is no move, the program observes something itself or does not visit an
            address, or a number is out of range.
    """
    refuse_no_move("check_move", move)
    draws = whole_number("a move is to be checked with {} draws", draws, least=100)
    whole_number("a move is to be checked by {} moves", moves)
    with undisturbed(whole_number("a move is to be checked with the seed {}", seed, least=0)):
        start = sample_strata(program, args, {}, draws)
        if bool((start.log_weights != 0.0).any()):
            raise InputError("the program observes something itself; let it sample every site.")
        strata, shares = start, []
        for _ in range(moves):
            strata, acceptance = move(strata, POSTERIOR)
            shares += [share for share in acceptance if share == share]
    data = [torch.cat([_of(each, address) for address in observed], dim=1) for each in (start, strata)]
    if observed and not torch.equal(*data):
        raise KernelError(f"the move changes {', '.join(map(repr, observed))}, observed; move latent values.")
    before, now = _columns(start, start, observed), _columns(strata, start, observed)
    if torch.equal(before, now):
        raise KernelError("the move moves no particle, so nothing is checked; propose shorter steps.")
    ordered = before.sort(dim=0).values.T.contiguous()
    structures = sorted(start.populations, key=lambda s: -len(start.populations[s]))[:MOST]
    change = _quantities(strata, now, ordered, structures) - _quantities(start, before, ordered, structures)
    return KernelCheck(check_change(change), sum(shares) / len(shares) if shares else math.nan)


def _of(strata: Strata, address: str) -> Tensor:
    """Numbers (N, D) at an address that all structures have, by the number of the draw."""
    strata[address]  # raises where one has none
    return _by_draw(strata, [site_numbers(each.trace, address) for each in strata.populations.values()])


def _by_draw(strata: Strata, rows: Sequence[Tensor]) -> Tensor:
    """Rows of the strata in the order of the draws from which the particles come."""
    founders = torch.cat([each.founders for each in strata.populations.values()])
    placed = torch.cat(list(rows))
    return torch.empty_like(placed).index_copy_(0, founders, placed)


def _columns(strata: Strata, start: Strata, observed: Sequence[str]) -> Tensor:
    """(N, L) by draw: densities of the data and of all, and the values that all structures have."""
    traces = [each.trace for each in start.populations.values()]
    common = [
        address
        for address in traces[0].choices
        if all(address in t.choices and t[address].shape[1:] == traces[0][address].shape[1:] for t in traces)
    ]
    densities = [
        torch.stack([t.log_prob(), *([t.log_prob(*observed)] if observed else [])], dim=1)
        for t in (each.trace for each in strata.populations.values())
    ]
    return torch.cat([_by_draw(strata, densities), *(_of(strata, address) for address in common)], dim=1)


def _quantities(strata: Strata, columns: Tensor, ordered: Tensor, structures: Sequence[Any]) -> Tensor:
    """(N, K): which structure a draw has, ranks of its columns among the first draws, and products."""
    values = columns.T.contiguous()
    rank = (torch.searchsorted(ordered, values) + torch.searchsorted(ordered, values, right=True)).T
    share = rank / len(columns) - 1.0
    of = [
        torch.tensor([[float(each == s) for each in structures]], dtype=torch.float64).expand(len(p), -1)
        for s, p in strata.populations.items()
    ]
    which = _by_draw(strata, of)
    first, second = torch.triu_indices(share.shape[1], share.shape[1])
    together = (which[:, :, None] * share[:, None, :]).flatten(1)
    return torch.cat([which, share, share[:, first] * share[:, second], together], dim=1)
