"""Deterministic values with the axis of the particles in another place than other sites are refused."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.errors import InputError
from bcppl.traces import generate


def schools(within: bool) -> None:
    with pyro.plate("schools", 8, dim=-2):
        eta = pyro.sample("eta", dist.Normal(torch.zeros(8, 1, dtype=torch.float64), 1.0))
        if within:
            pyro.deterministic("theta", 2.0 * eta)
    if not within:
        pyro.deterministic("theta", 2.0 * eta)


def test_outside_its_plate_a_value_has_its_axes_in_another_order() -> None:
    trace, _ = generate(schools, (True,), {}, 5)
    assert trace["theta"].shape == (5, 8)
    with pytest.raises(InputError, match=r"deterministic site 'theta' has shape \(8, 5\)"):
        generate(schools, (False,), {}, 5)
