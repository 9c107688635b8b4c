"""Moves across structures are checked from exact draws of the joint: right ones pass, mutants are found."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.calibration import KernelError
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.structures import Jump, check_move, in_turn, jump, translation, within
from bcppl.traces import Trace
from tests.inference.filters.smcp3_programs import silent
from tests.inference.structures.structural_programs import fewer, more, summed

Proposed = tuple[dict[str, Tensor], dict[str, Tensor]]


def split(trace: Trace) -> Proposed:
    """The last term becomes two, by a map with Jacobian 3."""
    last = trace.structure["count"]
    term = trace[f"term_{last}"]
    part = pyro.sample("part", dist.Normal(0.2 * term, 0.8))
    return {f"term_{last}": term - part, f"term_{last + 1}": 3.0 * part + term}, {}


def merged(trace: Trace) -> Proposed:
    last = trace.structure["count"]
    first, second = trace[f"term_{last - 1}"], trace[f"term_{last}"]
    part = (second - first) / 4.0
    return {f"term_{last - 1}": first + part}, {"part": part}


@pytest.mark.parametrize("seed", range(3))
def test_right_moves_pass(seed: int) -> None:
    birth = jump(Jump(more, fewer, split, merged))
    checked = check_move(birth, summed, (3,), ["y"], draws=4000, seed=seed)
    assert checked.p_value > 1e-4 and 0.05 < checked.acceptance < 1.0
    both = in_turn(within(metropolis_hastings(drift("term_0"))), jump(Jump(more, fewer)))
    assert check_move(both, summed, (3,), ["y"], draws=4000, seed=seed).p_value > 1e-4


def test_mutants_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    birth = jump(Jump(more, fewer, split, merged))
    with monkeypatch.context() as patch:
        patch.setattr(translation, "log_abs_det_jacobian", lambda *_, **__: torch.zeros(()))
        with pytest.raises(KernelError, match="does not leave the posterior invariant"):
            check_move(birth, summed, (3,), ["y"], draws=4000)
    with monkeypatch.context() as patch:
        patch.setattr(translation, "assessed", silent)
        with pytest.raises(KernelError, match="does not leave the posterior invariant"):
            check_move(jump(Jump(more, fewer, split, merged)), summed, (3,), ["y"], draws=4000)
    with pytest.raises(InputError, match="does not lead back"):
        check_move(jump(Jump(more, lambda s: None, split, merged)), summed, (3,), ["y"])


def test_what_cannot_be_checked_is_refused() -> None:
    birth = jump(Jump(more, fewer, split, merged))
    with pytest.raises(InputError, match="in place of a move of strata"):
        check_move(metropolis_hastings(drift("term_0")), summed, (3,), ["y"])
    with pytest.raises(InputError, match="term_1"):
        check_move(birth, summed, (3,), ["term_1"], draws=200)

    def still(strata: object, target: object) -> object:
        return strata, (0.0,)

    with pytest.raises(KernelError, match="moves no particle"):
        check_move(still, summed, (3,), ["y"], draws=200)
