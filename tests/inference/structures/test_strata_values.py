"""Values of strata and their means: of poses, angles, determined and structural ones."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference import Observed
from bcppl.inference.structures import (
    extend_strata,
    generate_strata,
    mean,
    probabilities,
)
from bcppl.traces import structural
from tests.invariance import matrix, number


def test_what_programs_determine_has_values_in_strata() -> None:
    def program() -> None:
        structural("k", dist.Categorical(matrix([0.5, 0.5])))
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.deterministic("twice", 2.0 * x)

    strata = generate_strata(program, (), {}, 6)
    assert torch.equal(strata["twice"], 2.0 * strata["x"]) and len(strata.visiting("twice")) == 6
    for population in strata.populations.values():
        assert torch.equal(population["twice"], 2.0 * population["x"])


def test_the_mean_of_a_pose_is_one_pose() -> None:
    def turned() -> None:
        which = structural("which", dist.Bernoulli(torch.tensor(0.5, dtype=torch.float64)))
        spread = torch.full((6,), 0.5, dtype=torch.float64).diag().square()
        pyro.sample("part", NormalPose(poses.as_pose([0.1 * which, 0, 0, 0, 1, 0, 0]), spread))

    torch.manual_seed(0)
    strata = generate_strata(turned, (), {}, 300)
    found = mean(strata, "part")
    torch.testing.assert_close(found, strata.belief("part").mean)
    assert float(found[3:].norm()) == pytest.approx(1.0)


def test_the_mean_of_an_angle_is_a_direction() -> None:
    def program() -> None:
        k = structural("k", dist.Bernoulli(torch.tensor(0.5)))
        pyro.sample("angle", dist.VonMises(torch.tensor(math.pi), 50.0 + 0.0 * k))

    torch.manual_seed(0)
    assert abs(float(mean(generate_strata(program, (), {}, 2000), "angle"))) == pytest.approx(
        math.pi, abs=0.02
    )


def test_a_structural_value_that_is_observed_names_its_stratum() -> None:
    def program(steps: int) -> None:
        structural("a", dist.Bernoulli(number(0.3)))
        for k in range(steps):
            structural(f"s_{k}", dist.Bernoulli(number(0.6)))

    torch.manual_seed(0)
    extended = extend_strata(generate_strata(program, (0,), {}, 50), Observed((1,), {"s_0": number(1.0)}))
    assert [dict(s) for s in extended.structures] == [{"a": 0, "s_0": 1}, {"a": 1, "s_0": 1}]
    assert probabilities(extended, "s_0").probabilities.tolist() == pytest.approx([1.0])


def test_means_are_of_what_all_structures_have() -> None:
    def program() -> None:
        more = structural("more", dist.Bernoulli(torch.tensor(0.5)))
        x = pyro.sample("x", dist.Normal(torch.tensor(0.0), 1.0))
        pyro.deterministic("double", 2.0 * x)
        if more:
            pyro.sample("z", dist.Normal(x, 1.0))

    strata = generate_strata(program, (), {}, particles=40)
    torch.testing.assert_close(mean(strata, "double"), 2.0 * mean(strata, "x"))
    for address in ("nope", "z"):
        with pytest.raises(InputError, match=repr(address)):
            mean(strata, address)
