"""A series as one program, with an address for each step: "x" of `init`, then "x/1", "x/2", ..."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pyro.poutine.messenger import Messenger

from bcppl.arguments import named
from bcppl.errors import InputError
from bcppl.traces import Series


@dataclass(frozen=True)
class Unrolled:
    """The program that `unrolled` makes."""

    series: Series

    def __call__(self, steps: Sequence[tuple[Any, ...]], *args: Any) -> Any:
        """Run `init(*args)` and a step with each of the arguments; returns the last state."""
        refuse_no_steps("an unrolled series", steps)
        with _Unnumbered(len(steps)):
            state = self.series.init(*args)
        for number, each in enumerate(steps, 1):
            with _Numbered(number):
                state = self.series.step(state, *each)
        return state


def unrolled(series: Series) -> Unrolled:
    """The program `(steps, *args)` of a series: `init(*args)`, and a step with each of the arguments.

    Its traces hold whole paths, whose values kernels can move: static parameters given the path by any kernel
    of `bcppl.inference.kernels`, the path given the parameters by `particle_gibbs`. What step t (from 1)
    visits at "x" has the address "x/t"; what `init` visits keeps its address.

    Args:
        series: of which `init` and `step` are run; whether it keeps its history does not matter.
    """
    return Unrolled(series)


def refuse_no_steps(what: str, steps: Any) -> None:
    """Refuse what is no list of the arguments of each step."""
    if not isinstance(steps, list | tuple) or not all(isinstance(each, list | tuple) for each in steps):
        raise InputError(
            f"{named(what + ' is given the steps {}', steps)}; give a list of the arguments of each step, "
            "such as [()] * 3 for three steps without any."
        )


def numbered(address: str, number: int) -> str:
    """The address in the unrolled program of what a step visits; 0 is `init`."""
    return f"{address}/{number}" if number else address


def by_step(addresses: Sequence[str], steps: int) -> list[list[str]]:
    """What `init` and then each of some steps visit, by the series' own addresses."""
    visited: list[list[str]] = [[] for _ in range(steps + 1)]
    for address in addresses:
        name, _, ending = address.rpartition("/")
        number = int(ending) if name and ending.isdecimal() and int(ending) <= steps else 0
        visited[number].append(name if number else address)
    return visited


class _Unnumbered(Messenger):
    """Refuses addresses of `init` that are those of a step's."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _pyro_sample(self, message: Any) -> None:
        name, _, ending = message["name"].rpartition("/")
        if name and ending.isdecimal() and 0 < int(ending) <= self.steps:
            raise InputError(
                f"a series' `init` samples {message['name']!r}, which is {name!r} of step {int(ending)}; "
                "name it otherwise."
            )


class _Numbered(Messenger):
    """Adds the number of a step to the addresses that are visited within."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def _pyro_sample(self, message: Any) -> None:
        message["name"] = numbered(message["name"], self.number)
