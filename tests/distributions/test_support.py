"""Outside the support of its site a value is impossible, and stays so through kernels, plates and masks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin as Distribution
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import average_distance
from bcppl.distributions.poses import MixturePose, NormalPose, SwingTwistPose, UniformPose
from bcppl.distributions.support import freedom_of, log_prob_inside
from bcppl.errors import InferenceError, InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.coordinates import PoseCoordinates, coordinates_of
from bcppl.poses import Freedom
from bcppl.traces import generate


def real(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


ONE = torch.tensor(1.0, dtype=torch.float64)


@pytest.mark.parametrize(
    ("distribution", "inside", "outside"),
    [
        (dist.Exponential(ONE), 0.5, -3.0),
        (dist.Gamma(2 * ONE, ONE), 0.5, -1.0),
        (dist.Beta(ONE, ONE), 0.5, 1.5),
        (dist.LogNormal(ONE, ONE), 0.5, -0.5),
        (dist.Bernoulli(0.3 * ONE), 1.0, 2.0),
        (dist.Poisson(ONE), 2.0, 1.5),
        (dist.Categorical(real(0.2, 0.8)), 1.0, 0.7),
        (dist.Categorical(real(0.2, 0.8)), 1.0, 7.0),
    ],
)
def test_what_lies_outside_the_support_is_impossible(
    distribution: Distribution, inside: float, outside: float
) -> None:
    def program() -> None:
        pyro.sample("x", distribution)

    state = torch.get_rng_state()
    trace, _ = generate(program, (), {}, 2)
    torch.set_rng_state(state)
    chosen = real(inside, outside)
    if not trace["x"].is_floating_point():
        chosen = chosen if outside == round(outside) else real(inside, 7.0)
    found = trace.at({"x": chosen.to(trace["x"].dtype)}).log_prob("x")
    torch.testing.assert_close(found[0], distribution.log_prob(real(inside))[0].to(torch.float64))
    assert float(found[1]) == -torch.inf
    assert torch.equal(torch.get_rng_state(), state)
    _, weight = generate(program, (), {"x": torch.tensor(outside, dtype=torch.float64)}, 3)
    assert bool((weight == -torch.inf).all())


@pytest.fixture(autouse=True)
def unvalidated() -> Iterator[None]:
    with pyro.validation_enabled(False):
        yield


def test_plates_events_and_masks() -> None:
    value = real(0.5, -1.0, 0.5, 0.5).reshape(2, 2)
    each = dist.Exponential(ONE).expand([2, 2])
    assert (log_prob_inside(each, value) == -torch.inf).tolist() == [[False, True], [False, False]]
    rows = each.to_event(1)
    torch.testing.assert_close(log_prob_inside(rows, value), real(-torch.inf, -1.0))
    seen = torch.tensor([[True, False], [True, True]])
    torch.testing.assert_close(log_prob_inside(each.mask(seen).to_event(1), value), real(-0.5, -1.0))
    whole = dist.Categorical(real(0.2, 0.8)).expand([2]).mask(torch.tensor([True, False]))
    torch.testing.assert_close(log_prob_inside(whole, torch.tensor([1, 9])), real(0.8, 1.0).log())

    def program() -> None:
        with pyro.plate("points", 2, dim=-2):
            pyro.sample("x", dist.Exponential(ONE))

    _, weight = generate(program, (), {"x": real(0.5, -1.0)}, 3)
    assert bool((weight == -torch.inf).all())


def test_what_is_no_number_is_not_taken_for_impossible() -> None:
    def program() -> None:
        pyro.sample("x", dist.Exponential(ONE))

    with pytest.raises(InferenceError, match="NaN"):
        generate(program, (), {"x": torch.tensor(torch.nan, dtype=torch.float64)}, 3)


def test_a_random_walk_stays_inside() -> None:
    torch.manual_seed(0)
    count = 4000

    def program() -> None:
        pyro.sample("x", dist.Exponential(ONE))

    trace, _ = generate(program, (), {}, count)
    for _ in range(20):
        proposed = trace.at({"x": trace["x"] + torch.randn(count, dtype=torch.float64)})
        accepted = torch.rand(count).log() < proposed.log_prob() - trace.log_prob()
        trace = proposed.where(accepted, trace)
    assert float(trace["x"].min()) >= 0
    # Drawn exactly and moved by a kernel that keeps the target.
    assert float(trace["x"].mean()) == pytest.approx(1.0, abs=4 * count**-0.5)


def test_a_mask_or_another_shape_leaves_a_pose_a_pose() -> None:
    prior = UniformPose(poses.identity(), [0.01, 0.0, 0.0], 0.1, rotation="z")
    for wrapped in (prior, prior.mask(torch.tensor(True)), prior.expand([3]).to_event(1).mask(False)):
        assert freedom_of(wrapped) == Freedom("x", "z")
    assert freedom_of(dist.Normal(ONE, ONE).expand([7]).to_event(1)) is None

    def program() -> None:
        pyro.sample("pose", prior.mask(torch.tensor(True)))

    trace, _ = generate(program, (), {}, 4)
    assert isinstance(coordinates_of(trace, "pose"), PoseCoordinates)
    assert Population(trace).belief("pose").freedom == Freedom("x", "z")


def test_seven_numbers_without_a_unit_quaternion_are_no_pose() -> None:
    center, deviations = poses.identity(), real(0.01, 0.01, 0.01, 0.1, 0.1, 0.1)
    normal = NormalPose(center, deviations)
    mixture = MixturePose(real(0.0), center[None], deviations)
    priors = (normal, mixture, UniformPose(center, 0.1, 3.1), SwingTwistPose(center, 0.1, 0.1, 0.1))
    scale = real(1.0, -1.0, 1.0 + 1e-8, 0.0, 2.0, 1.01)
    value = center * torch.ones(6, 1, dtype=torch.float64)
    value[:, 3:] *= scale[:, None]
    for prior in priors:
        found = prior.log_prob(value)
        assert bool(found[:3].isfinite().all())
        assert bool((found[3:] == -torch.inf).all())
    with pytest.raises(InputError, match="unit length"):
        NormalPose(value, deviations)
    with pytest.raises(InputError, match="quaternion of length 2"):
        average_distance(center, torch.zeros(1, 3, dtype=torch.float64), value[4])


@pytest.mark.parametrize(
    ("distribution", "impossible", "possible"),
    [
        (dist.Categorical(real(0.6, 0.0, 0.4)), 1, 2),
        (dist.Categorical(torch.tensor([0.6, 0.0, 0.4])), 1, 0),
        (dist.OneHotCategorical(real(0.6, 0.0, 0.4)), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
        (dist.Bernoulli(0.0 * ONE), 1.0, 0.0),
        (dist.Bernoulli(ONE), 0.0, 1.0),
        (dist.Binomial(3, 0.0 * ONE), 1.0, 0.0),
        (dist.Geometric(ONE), 2.0, 0.0),
    ],
)
def test_a_stated_probability_of_0_is_0(distribution: Distribution, impossible: Any, possible: Any) -> None:
    for each in (distribution, distribution.expand([3])):
        assert bool((log_prob_inside(each, torch.as_tensor(impossible)) == -torch.inf).all())
        assert bool((log_prob_inside(each, torch.as_tensor(possible)) > -1.0).all())


def test_a_probability_that_rounds_to_0_is_that_of_its_logits() -> None:
    assert float(log_prob_inside(dist.Categorical(logits=real(0.0, -800.0)), torch.tensor(1))) == -800.0
    bernoulli = dist.Bernoulli(logits=real(40.0))
    assert float(bernoulli.probs) == 1.0 and float(log_prob_inside(bernoulli, real(0.0))) == -40.0


def test_parameters_that_are_no_numbers_count_where_an_earlier_value_is_possible() -> None:
    def program() -> None:
        scale = pyro.sample("scale", dist.HalfNormal(ONE))
        pyro.sample("y", dist.Normal(0.0, scale.log().sqrt()))

    observed = {"y": real(0.7)[0]}
    _, weight = generate(program, (), observed, 2, {"scale": real(-1.0, 1.5)})
    assert weight[0] == -torch.inf and math.isfinite(weight[1])
    with pytest.raises(InferenceError, match="site 'y' has a log-probability of nan for 1 of 2"):
        generate(program, (), observed, 2, {"scale": real(0.5, 1.5)})
