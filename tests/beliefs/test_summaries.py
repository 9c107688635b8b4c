"""Summaries of a population's addresses, against weighted sums done by hand."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl import poses
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.summaries import covariance, mean, probabilities, quantiles
from bcppl.traces import Series, extend, generate, simulate


def number(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def program() -> None:
    pyro.sample("which", dist.Categorical(number(0.2, 0.3, 0.5)))
    pyro.sample("at", dist.Normal(torch.zeros(2, dtype=torch.float64), 1.0).to_event(1))
    pyro.sample("hole", UniformPose(poses.identity(), (0.02, 0.01, 0.0), 0.5, "z"))
    pyro.sample("seen", dist.Normal(number(0.0)[0], 1.0))


def population() -> Population:
    torch.manual_seed(0)
    trace, _ = generate(program, (), {"seen": number(0.5)[0]}, 4)
    trace = trace.at(
        {
            "which": torch.tensor([2, 0, 2, 1]),
            "at": torch.stack([number(0, 1, 2, 99), number(1, 1, 3, 99)], 1),
        }
    )
    return Population(trace, number(0.5, 0.25, 0.25, 0.0).log() + 40.0)


def test_moments_and_quantiles_by_hand() -> None:
    found = population()
    torch.testing.assert_close(mean(found, "at"), number(0.75, 1.5))
    torch.testing.assert_close(
        covariance(found, "at"), torch.stack([number(0.6875, 0.625), number(0.625, 0.75)])
    )
    torch.testing.assert_close(
        quantiles(found, "at", [0.5, 0.9]), torch.stack([number(0.5, 1), number(2, 3)])
    )
    torch.testing.assert_close(mean(found, "which"), number(1.5)[0])
    assert float(quantiles(found, "which", 0.1)) == 0.0


def test_probabilities_count_weight_and_not_particles() -> None:
    values, share = probabilities(population(), "which")
    assert values.tolist() == [0, 2], "the particle without weight has no say"
    torch.testing.assert_close(share, number(0.25, 0.75))


def test_a_pose_is_summed_up_as_a_belief() -> None:
    found = population()
    belief = found.belief("hole")
    assert torch.equal(mean(found, "hole"), belief.mean)
    assert torch.equal(covariance(found, "hole"), belief.covariance)
    held = quantiles(found, "hole", [0.1, 0.9])[:, 2:5]
    assert float(held.abs().max()) == 0.0


def test_an_address_that_is_not_latent_is_refused() -> None:
    for address in ("seen", "nowhere"):
        with pytest.raises(InputError, match=f"{address}' was asked for, which is no latent address"):
            mean(population(), address)
    assert math.isfinite(float(mean(population(), "which")))


def test_an_earlier_step_of_a_series_is_weighed_by_where_it_led() -> None:
    def init() -> torch.Tensor:
        return pyro.sample("x", dist.Normal(number(0.0)[0], 1.0))

    def step(x: torch.Tensor) -> torch.Tensor:
        x = pyro.sample("x", dist.Normal(x, 0.5))
        pyro.sample("hole", UniformPose(poses.identity(), (0.02, 0.01, 0.0), 0.5, "z"))
        return x

    torch.manual_seed(0)
    first, _ = generate(Series(init, step), (), {}, 4)
    second, _ = extend(first[torch.tensor([3, 1, 1, 0])], (), {})
    third, _ = extend(second, (), {})
    found = Population(third, number(0.5, 0.25, 0.25, 0.0).log())
    began = first["x"]
    torch.testing.assert_close(mean(found, ("x", 0)), 0.5 * began[3] + 0.5 * began[1])
    assert float(quantiles(found, ("x", 0), 0.99)) == max(float(began[3]), float(began[1]))
    torch.testing.assert_close(mean(found, ("x", 2)), mean(found, "x"))
    torch.testing.assert_close(
        mean(found, ("hole", 1)), Population(second, found.log_weights).belief("hole").mean
    )
    with pytest.raises(InputError, match="step 3 of a series"):
        mean(found, ("x", 3))


def test_what_a_series_samples_at_its_beginning_alone_is_summarised_too() -> None:
    """Wherever `trace["a", 0]` has a value: addresses of `init`, poses, and the entries of plates."""

    def init() -> torch.Tensor:
        pyro.sample("hole", UniformPose(poses.identity(), (0.02, 0.01, 0.0), 0.5, "z"))
        pyro.sample("kind", dist.Bernoulli(number(0.5)[0]))
        with pyro.plate("three", 3, dim=-2):
            return pyro.sample("a", dist.Normal(number(0.0)[0], 1.0)).movedim(-1, 0)

    def step(a: torch.Tensor) -> torch.Tensor:
        pyro.sample("b", dist.Normal(a.sum(-1), 1.0))
        return a

    torch.manual_seed(0)
    trace, _ = generate(Series(init, step), (), {}, 4)
    trace, _ = extend(trace[[3, 3, 0, 1]], (), {})
    found = Population(trace[[1, 0, 2, 2]], number(0.5, 0.25, 0.25, 0.0).log())
    weights = number(0.5, 0.25, 0.25, 0.0)
    torch.testing.assert_close(mean(found, ("a", 0)), weights @ found.trace["a", 0])
    assert mean(found, ("a", -2)).shape == (3,) and quantiles(found, ("a", 0), [0.1, 0.9]).shape == (2, 3)
    assert covariance(found, ("a", 0)).shape == (3, 3)
    assert mean(found, ("hole", 0)).shape == (7,) and covariance(found, ("hole", 0)).shape == (6, 6)
    assert float(probabilities(found, ("kind", 0)).probabilities.sum()) == pytest.approx(1.0)
    torch.testing.assert_close(mean(found, ("b", 1)), mean(found, "b"))
    for address in (("a", 1), ("b", 0)):
        with pytest.raises(
            InputError, match=rf"step {address[1]} was asked for at '{address[0]}', which is no latent"
        ):
            mean(found, address)
    with pytest.raises(InputError, match="'a' was asked for, which is no latent address; latent are b"):
        mean(found, "a")


def test_what_a_program_determines_has_values_and_summaries_particle_axis_first() -> None:
    def rows() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0)[0], 1.0))
        pyro.deterministic("twice", 2.0 * x)
        pyro.deterministic("both", torch.stack([x, -x], dim=-1))
        pyro.deterministic("constant", number(3.0, 4.0, 5.0))
        with pyro.plate("rows", 3):
            z = pyro.sample("z", dist.Normal(x, 1.0))
            pyro.deterministic("shifted", z + 1.0)
            pyro.deterministic("outer", x + 1.0)
            pyro.deterministic("pairs", torch.stack([z, x.expand_as(z)], dim=-1), event_dim=1)
        pyro.sample("seen", dist.Normal(x, 1.0))

    trace, _ = generate(rows, (), {"seen": number(0.5)[0]}, 5)
    x, z = trace["x"], trace["z"]
    expected = {
        "twice": 2.0 * x,
        "both": torch.stack([x, -x], dim=1),
        "constant": number(3.0, 4.0, 5.0).expand(5, 3),
        "shifted": z + 1.0,
        "outer": x + 1.0,
        "pairs": torch.stack([z, x[:, None].expand(5, 3)], dim=2),
    }
    index = torch.tensor([3, 3, 0, 1])
    for address, value in expected.items():
        torch.testing.assert_close(trace[address], value, rtol=0, atol=0, msg=address)
        torch.testing.assert_close(trace[index][address], value[index], rtol=0, atol=0, msg=address)
    found = Population(trace, torch.randn(5, dtype=torch.float64))
    torch.testing.assert_close(mean(found, "twice"), 2.0 * mean(found, "x"))
    torch.testing.assert_close(mean(found, "shifted"), mean(found, "z") + 1.0)
    with pytest.raises(InputError, match="it has x, z, seen, twice"):
        trace["thrice"]


def test_what_a_step_determines_is_that_of_each_particles_ancestor() -> None:
    def step(x: torch.Tensor) -> torch.Tensor:
        x = pyro.sample("x", dist.Normal(x, 1.0))
        pyro.deterministic("square", x**2)
        return x

    trace, _ = generate(Series(lambda: pyro.sample("x", dist.Normal(number(0.0)[0], 1.0)), step), (), {}, 6)
    for _ in range(3):
        trace, _ = extend(trace[torch.randint(6, (6,))], (), {})
    for then in (1, 2, -1):
        torch.testing.assert_close(trace["square", then], trace["x", then] ** 2)
    found = Population(trace)
    torch.testing.assert_close(mean(found, ("square", 1)), (trace["x", 1] ** 2).mean())


def test_summaries_of_an_angle_do_not_depend_on_the_cut() -> None:
    def pointing() -> None:
        pyro.sample("angle", dist.VonMises(torch.tensor(math.pi, dtype=torch.float64), 20.0))

    torch.manual_seed(0)
    population = Population(simulate(pointing, (), 4000))
    assert abs(math.cos(float(mean(population, "angle"))) + 1.0) < 1e-3
    assert float(covariance(population, "angle")) == pytest.approx(0.05, rel=0.15)
    low, high = quantiles(population, "angle", [0.05, 0.95]).tolist()
    assert high - low == pytest.approx(2 * 1.645 * math.sqrt(0.0513), rel=0.1)


def test_a_pose_that_is_determined_is_summed_up_as_one() -> None:
    def held() -> None:
        around = NormalPose(poses.identity(), torch.full((6,), 0.01, dtype=torch.float64).diag().square())
        part = pyro.sample("part", around)
        flip = torch.where(torch.arange(len(part)) % 2 == 0, 1.0, -1.0)[:, None]
        pyro.deterministic("again", torch.cat([part[:, :3], flip * part[:, 3:]], dim=1), event_dim=1)

    torch.manual_seed(0)
    population = Population(simulate(held, (), 200))
    torch.testing.assert_close(mean(population, "again").abs(), mean(population, "part").abs())
    torch.testing.assert_close(covariance(population, "again"), covariance(population, "part"))
