"""Errors of a bench at the ends of their ranges, and copies of a likelihood that has them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bcppl.distributions.episodes import Delay, Grasp
from bcppl.errors import InputError
from tests.distributions.touches.test_linear_errors import FIVE, site
from tests.distributions.touches.test_manifold import around
from tests.made_recordings import assert_one_sentence


def test_a_grasp_that_is_known_at_first_may_slip_all_the_same() -> None:
    """As the limit of one that is known ever better, and unlike one that never slips."""
    pose = around(4, 0, 5e-4, 3e-3)

    def density(**own: float) -> Tensor:
        return site(pose, FIVE, Grasp(**{"slips": 0.2, "slip": 0.002, **own})).log_prob(FIVE)

    known = density(shift=0.0)
    torch.testing.assert_close(known, density(shift=1e-7), rtol=1e-3, atol=1e-3)
    assert float((known - density(shift=0.0, slips=0.0)).abs().max()) > 0.1


def test_a_copy_with_other_arguments_remembers_nothing_of_the_first() -> None:
    one = site(around(4), FIVE)
    before = one.log_prob(FIVE)
    rough = replace(one, shared=3e-4).log_prob(FIVE)
    torch.testing.assert_close(rough, replace(site(around(4), FIVE), shared=3e-4).log_prob(FIVE))
    assert not torch.allclose(rough, before)


def test_a_delay_is_within_what_rows_know_of() -> None:
    with pytest.raises(InputError, match="longest") as refused:
        Delay(longest=0.1)
    assert_one_sentence(str(refused.value))
