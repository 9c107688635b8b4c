"""However a latent value reaches a likelihood, an update has the densities of a new run, or is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import pytest
import torch

from bcppl.traces import Fault, ProgramError, Trace, check_program, generate, update
from tests.small_programs import normal_log
from tests.traces.hidden_inputs import HIDDEN
from tests.wrong_programs.catalogue import normal

N = 7
# Nothing that a distribution holds, and no variable that its code names, shows that these have changed.
UNSEEN = {
    "context_variable",
    "cached_function",
    "object_written_into",
    "array_that_is_held_and_written_into",
    "environment",
    "table of weak keys",
}

CUT = {"module_parameter"}  # a parameter that is made of a value is a leaf, with a gradient of its own


def program_of(make: Callable[..., Any]) -> Callable[[], None]:
    def program() -> None:
        x, shift = normal("x"), normal("shift")
        pyro.sample("y", make(x, shift))

    return program


def right(trace: Trace) -> bool:
    own = torch.as_tensor(trace.log_prob("y"))
    return any(
        torch.allclose(own, normal_log(trace["y"], trace["x"] + gain * trace["shift"], 1.0))
        for gain in (1.0, 2.0)
    )


@pytest.mark.parametrize("name", HIDDEN)
def test_an_update_has_the_densities_of_a_new_run_or_the_program_is_refused(name: str) -> None:
    torch.manual_seed(0)
    program = program_of(HIDDEN[name])
    trace, _ = generate(program, (), {"y": 0.3}, N)
    assert right(trace)
    moved = update(trace, {"shift": trace["shift"] + 1.0}).trace
    seen = right(moved)
    assert seen == (name not in UNSEEN)
    try:
        check_program(program, (), {"y": 0.3})
    except ProgramError as error:
        fault = Fault.GRADIENT if name in CUT else Fault.DEPENDENCE
        assert error.fault is fault and error.site == "y", str(error)
        checked = False
    else:
        checked = True
    assert seen or not checked
