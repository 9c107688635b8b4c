"""A series that is not well formed is refused in one sentence that states what to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces import Series, extend, simulate
from tests.invariance import number

N = 6


def in_a_plate() -> Tensor:
    with pyro.plate("points", 4):
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))


def alone() -> Tensor:
    return pyro.sample("x", dist.Normal(number(0.0), 1.0))


def onward(x: Tensor) -> Tensor:
    return pyro.sample("x", dist.Normal(x, 1.0))


def forgetting(x: Tensor) -> None:
    pyro.sample("x", dist.Normal(x, 1.0))


WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "state in a plate": (lambda: simulate(Series(in_a_plate, onward), (), N), r"\(4, 6\) .*`.to_event\(1\)`"),
    "state in a plate of N": (
        lambda: simulate(Series(in_a_plate, onward), (), 4),
        r"coincidence alone; .*\(4, 5\) .*`.to_event\(1\)`",
    ),
    "no return": (
        lambda: extend(simulate(Series(alone, forgetting), (), N), (), {}),
        "step returned nothing.* return the next state",
    ),
    "swapped": (lambda: simulate(Series(onward, alone), (), N), "init of a series, 'onward', .*missing.*'x'"),
    "arguments": (
        lambda: extend(simulate(Series(alone, onward), (), N), (1, 2), {}),
        "step of a series, 'onward', .*too many",
    ),
    "no function": (lambda: Series(alone, 3), "step of a series is of type int; give two functions"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("case", WRONG)
def test_a_series_that_is_not_put_together_right_is_refused_in_a_sentence(case: str) -> None:
    act, says = WRONG[case]
    with pytest.raises(InputError, match=says) as caught:
        act()
    assert ". " not in str(caught.value) and "\n" not in str(caught.value)
