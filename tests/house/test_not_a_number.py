"""A likelihood that is not a number stops guided SMC; it tempers only where all weight is lost."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import errors, poses
from bcppl.beliefs import normalised
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InferenceError
from bcppl.inference.filters.guided_smc import Approximation, guided, kernel
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair
from bcppl.inference.population import Population
from bcppl.poses import Freedom
from bcppl.traces import Model, Program, Trace, simulate

SLIDING = Freedom("xyz", "none")
PRIOR, NOISE, SEEN, FAR = 0.02, 0.004, 0.01, 0.3  # metres
PARTICLES = 20


class Seen(LazyDistribution):
    """Where the part is seen along x; beyond `FAR` the sensor's model gives `beyond`, if that is not None."""

    def __init__(self, part: Tensor, beyond: float | None) -> None:
        self.part, self.beyond = part, beyond
        super().__init__(len(part), ())

    def log_prob(self, value: Tensor) -> Tensor:
        x = self.part[:, 0]
        density = dist.Normal(x, NOISE).log_prob(value)
        return density if self.beyond is None else torch.where(x > FAR, self.beyond, density)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return dist.Normal(self.part[:, 0], NOISE).sample()


def program(beyond: Sequence[float | None], actions: Sequence[Any]) -> None:
    part = pyro.sample("part", NormalPose(poses.identity(), torch.full((3,), PRIOR).double(), SLIDING))
    for k in range(len(actions)):
        pyro.sample(f"seen_{k}", Seen(part, beyond[k]))


@dataclass(frozen=True)
class Sight:
    kind: str = "sight"
    action: None = None
    observation: None = None


RECORDING: Any = SimpleNamespace(measurements=[Sight(), Sight()], truth=None)


def around(x: Sequence[float]) -> Program:
    """A proposal: each particle goes to one of some places along x, in turn."""

    def program(trace: Trace) -> None:
        center = poses.identity(trace.particles)
        center[:, 0] = torch.tensor(x, dtype=torch.float64).repeat(trace.particles)[: trace.particles]
        pyro.sample("part", NormalPose(center, torch.full((3,), PRIOR).double(), SLIDING))

    return program


@dataclass(frozen=True)
class Counted(Approximation):
    """An approximation that knows the number of measurements."""

    count: int = 0

    def including(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> Counted:
        return Counted(number + 1)

    deferring = including

    def updated(self) -> Counted:
        return self


@dataclass(frozen=True)
class To:
    """Forward kernels to the places that are given for each measurement."""

    places: Sequence[Sequence[float]]

    def __call__(self, before: Counted, after: Counted, action: Any) -> Pair:
        return Pair(around(self.places[before.count]), around([0.0]))


def run(beyond: Sequence[float | None], places: Sequence[Sequence[float]]) -> Iterator[Step]:
    """Guided SMC, given what the sites give beyond `FAR` and where forward kernels lead, by measurement."""
    observed = torch.tensor(SEEN, dtype=torch.float64)

    def observe(scene: Any, measurements: Sequence[Any]) -> dict[str, Tensor]:
        return {f"seen_{k}": observed for k in range(len(measurements))}

    model = Model(program, lambda recording: beyond, observe, "part")
    step = guided(lambda scene: Counted(), To(places), kernel("part", lambda approximation: ()))
    return smc(model, RECORDING, step=step, particles=PARTICLES, seed=0)


@pytest.mark.parametrize("at", [1, 2])
def test_a_likelihood_that_is_no_number_stops_the_run_and_names_the_site(at: int) -> None:
    """Half of the particles are led there; tempering would not go there and hide it."""
    wrong = [math.nan if k + 1 == at else None for k in range(2)]
    places = [[2.0 * FAR, SEEN] if k + 1 == at else [SEEN] for k in range(2)]
    message = rf"sight {at}.*'seen_{at - 1}'.*nan.* of \d+ particles"
    with pytest.raises(InferenceError, match=message) as caught:
        list(run(wrong, places))
    assert isinstance(caught.value, errors.NotANumberError)


def test_where_all_weight_is_lost_the_likelihood_is_tempered() -> None:
    """The forward kernel leads all particles to where the likelihood is zero: that alone is no mistake."""
    *_, last = run([-math.inf] * 2, [[2.0 * FAR]] * 2)
    assert last.taken == 2 and float(last.belief.world_from_part[:, 0].max()) < FAR


def test_both_are_errors_of_inference_and_differ() -> None:
    assert issubclass(errors.NoWeightError, InferenceError)
    assert issubclass(errors.NotANumberError, InferenceError)
    assert not issubclass(errors.NotANumberError, errors.NoWeightError)
    assert not issubclass(errors.NoWeightError, errors.NotANumberError)


@pytest.mark.parametrize(("weight", "kind"), [(-math.inf, "NoWeightError"), (math.nan, "NotANumberError")])
def test_weights_raise_the_one_that_fits(weight: float, kind: str) -> None:
    factor = torch.full((PARTICLES,), weight, dtype=torch.float64)
    trace = simulate(program, ([], []), PARTICLES)
    for weigh in (Population(trace, torch.zeros_like(factor)).reweighed, normalised):
        with pytest.raises(InferenceError) as caught:
            weigh(factor)
        assert isinstance(caught.value, getattr(errors, kind))
