"""Choices that determine which sites a program visits: one value for all particles of a trace.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.traces import generate, structural

    def program():
        if structural("slipped", dist.Bernoulli(0.1)):
            shift = pyro.sample("shift", dist.Normal(torch.tensor(0.0), 2.0))
        else:
            shift = torch.tensor(0.0)
        pyro.sample("y", dist.Normal(shift, 0.5))

    seen = {"slipped": torch.tensor(1), "y": torch.tensor(1.2)}
    trace, log_weight = generate(program, (), seen, particles=100)
    print(trace, trace.structure)

The value is a Python int, so the program branches on it with `if` and `for`. A trace is a run for one value,
conditioned on it as on an observation: its log-probability counts as that of any other site. A posterior over
several values is one trace for each, a `bcppl.inference.structures.Strata`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pyro
import torch
from torch import Tensor

from bcppl.errors import InputError

STRUCTURAL = "structural"  # the flag of a structural site, in Pyro's `infer` of the site


class Structure(Mapping[str, int]):
    """The values of a trace's structural sites by address; hashable, and equal to a dict of the same."""

    def __init__(self, values: Mapping[str, int]) -> None:
        self._values = {address: int(value) for address, value in values.items()}

    def __getitem__(self, address: str) -> int:
        return self._values[address]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        return hash(frozenset(self._values.items()))

    def __repr__(self) -> str:
        return f"Structure({', '.join(f'{a}={v}' for a, v in self._values.items())})"

    def with_values(self, values: Mapping[str, int]) -> Structure:
        """This structure with some values replaced or added."""
        return Structure({**self._values, **values})

    @property
    def observations(self) -> dict[str, Tensor]:
        """The values as observations of a trace, float64: a trace is conditioned on its structure."""
        return {address: torch.tensor(value, dtype=torch.float64) for address, value in self._values.items()}


class UnchosenError(InputError):
    """A program visited a structural site that was given no value.

    Attributes:
        address: of the site.
        distribution: of the site, of batch shape (N,).
        values: of the sites visited before, by address, given ones too; the particle axis first. What the
            program itself fixes (`obs=`, `pyro.factor`) is left out.
    """

    def __init__(self, address: str, distribution: Any, values: Mapping[str, Tensor]) -> None:
        super().__init__(
            f"site {address!r} determines which sites the program visits, and has no value; observe it for a "
            f"trace of one structure (and to check that: check_program(..., {{{address!r}: 1}})); for all, "
            "use generate_strata of bcppl.inference.structures, or extend_strata where an observation brings "
            "it."
        )
        self.address, self.distribution, self.values = address, distribution, values


def structural(name: str, distribution: Any) -> int:
    """The value of a discrete site on which the program may branch: the same for all particles of a trace.

    Args:
        name: the address.
        distribution: over whole numbers, of batch shape () or (N,): it may depend on earlier latent values.

    Raises:
        UnchosenError: the site is given no value; it is never sampled for each particle by itself.
        InputError: it is given values that differ from particle to particle, or lies in a plate.
    """
    infer: Any = {STRUCTURAL: True}
    value = pyro.sample(name, distribution, infer=infer)
    first = value.reshape(-1)[0]
    if not bool((value == first).all()):
        raise InputError(
            f"structural site {name!r} is given values that differ between particles or in a plate; "
            "give one value for each trace, and a site of its own to each entry of a plate."
        )
    return int(first)
