"""Guided SMC: exact where the approximation is, unbiased where it is not, and reproducible."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError, NotANumberError
from bcppl.geometry.parts import Guess
from bcppl.inference.filters import tempered_smc
from bcppl.inference.filters.guided_smc import Approximation, guided, infer, kernel
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair, smcp3
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.population import Population
from bcppl.inference.resampling import never
from bcppl.inference.targets import POSTERIOR
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.poses import Freedom
from bcppl.sensors.measurements import Recording
from bcppl.traces import Model, Program, Trace, generate
from tests.inference.filters.checked_pairs import run_checked
from tests.made_recordings import assert_one_sentence

# ---------------------------------------------------------------- a part that slides, seen with noise

SLIDING = Freedom("xyz", "none")
PRIOR, NOISE = torch.tensor([0.02, 0.03, 0.01], dtype=torch.float64), 0.004
SEEN = torch.tensor(
    [[0.03, -0.02, 0.005], [0.028, -0.024, 0.002], [0.035, -0.021, 0.004]], dtype=torch.float64
)


def sliding(scene: Any, actions: Sequence[Any]) -> None:
    part = pyro.sample("part", NormalPose(poses.identity(), torch.diag(PRIOR**2), SLIDING))
    for k in range(len(actions)):
        pyro.sample(f"seen_{k}", dist.Normal(part[:, :3], NOISE).to_event(1))


def observe(scene: Any, measurements: Sequence[Any]) -> dict[str, Tensor]:
    return {f"seen_{m.number}": SEEN[m.number] for m in measurements}


MODEL = Model(sliding, lambda recording: None, observe, "part")


@dataclass(frozen=True)
class Sight:
    """A measurement of the toy."""

    number: int
    kind: str = "sight"
    action: None = None
    observation: None = None


RECORDING: Any = SimpleNamespace(measurements=[Sight(k) for k in range(len(SEEN))], truth=None)


@dataclass(frozen=True)
class Exact(Approximation):
    """The posterior given the first so many measurements, whose sum is (3,)."""

    count: int = 0
    total: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    def including(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> Exact:
        return type(self)(self.count + 1, self.total + observations[f"seen_{number}"])

    deferring = including

    def updated(self) -> Exact:
        return self

    def posterior(self, wider: float) -> NormalPose:
        precision, center = PRIOR**-2 + self.count / NOISE**2, poses.identity()
        center[:3] = self.total / NOISE**2 / precision
        return NormalPose(center, torch.diag(wider**2 / precision), SLIDING)


def redrawn(proposed: NormalPose) -> Program:
    def program(trace: Trace) -> None:
        pyro.sample("part", proposed)

    return program


@dataclass(frozen=True)
class Pairs:
    """Forward and backward kernels that draw from posteriors, so many times as wide."""

    forward: float = 1.0
    backward: float = 1.0

    def __call__(self, before: Exact, after: Exact, action: Any) -> Pair:
        return Pair(redrawn(after.posterior(self.forward)), redrawn(before.posterior(self.backward)))


class NotBack(Pairs):
    """Mutant: a backward kernel that forgets nothing."""

    def __call__(self, before: Exact, after: Exact, action: Any) -> Pair:
        return super().__call__(after, after, action)


WIDER, NOT_BACK = Pairs(1.6, 1.4), NotBack(1.6, 1.4)


def run(pair: Pairs, particles: int, seed: int) -> Iterator[Step]:
    step = guided(lambda scene: Exact(), pair, kernel("part", lambda approximation: ()))
    return smc(MODEL, RECORDING, step=step, particles=particles, seed=seed)


def evidence(count: int = len(SEEN)) -> float:
    total = 0.0
    for axis in range(3):
        covariance = NOISE**2 * torch.eye(count).double() + PRIOR[axis] ** 2
        total += float(
            MultivariateNormal(torch.zeros(count).double(), covariance).log_prob(SEEN[:count, axis])
        )
    return total


def test_with_exact_kernels_every_weight_is_the_evidence() -> None:
    steps = list(run(Pairs(), particles=40, seed=1))
    for step in steps[1:]:
        assert step.info.log_evidence == pytest.approx(evidence(step.taken), abs=1e-8)
    belief = steps[-1].belief
    assert belief.effective_sample_size > 30
    precision = PRIOR**-2 + len(SEEN) / NOISE**2
    off = belief.mean[:3] - SEEN.sum(dim=0) / NOISE**2 / precision
    assert bool((off.abs() * precision.sqrt() < 5 / math.sqrt(40)).all())


def ratios(pairs: Pairs, runs: int, particles: int = 30) -> np.ndarray:
    """Estimated over true evidence, by the pair alone."""

    def step(population: Population, observed: Any) -> Any:
        before = Exact() if population.approximation is None else population.approximation
        number = len(observed.args[1]) - 1
        after = before.including(None, number, None, observed.observations)
        pair = pairs(before, after, None)
        return smcp3(pair, resample=never)(population.with_approximation(after), observed)

    estimates = []
    for seed in range(runs):
        *_, last = smc(MODEL, RECORDING, step=step, particles=particles, seed=seed)
        estimates.append(math.exp(last.info.log_evidence - evidence()))
    return np.array(estimates)


def test_evidence_is_unbiased_and_a_wrong_backward_kernel_shows_in_it() -> None:
    right = ratios(WIDER, 60)
    assert abs(right.mean() - 1.0) < 4.0 * right.std(ddof=1) / math.sqrt(len(right))
    assert 0.01 < right.std() < 1.0
    wrong = ratios(NOT_BACK, 10)
    assert np.median(wrong) < 0.5 or wrong.std() > 2.0 * right.std()


def test_the_whole_step_agrees_with_tempering_and_with_the_truth() -> None:
    runs = [list(run(WIDER, particles=60, seed=s))[-1] for s in range(3)]
    tempered = list(tempered_smc.infer(MODEL, RECORDING, particles=40, seed=0))[-1]
    assert abs(np.mean([run.info.log_evidence for run in runs]) - evidence()) < 0.3
    assert tempered.info.log_evidence == pytest.approx(evidence(), abs=2.0)
    means = torch.stack([run.belief.mean[:3] for run in runs]).mean(dim=0)
    assert float((means - tempered.belief.mean[:3]).abs().max()) < 0.0015


@dataclass(frozen=True)
class Elsewhere(Pairs):
    """A forward kernel of its own, whatever the approximation."""

    proposed: Any = None

    def __call__(self, before: Exact, after: Exact, action: Any) -> Pair:
        return replace(super().__call__(before, after, action), forward=redrawn(self.proposed))


def test_where_a_forward_kernel_misses_the_posterior_the_likelihood_is_tempered() -> None:
    center = poses.identity()
    center[:3] = 0.4
    astray = NormalPose(center, torch.full((3,), 1e-3).double(), SLIDING)
    *_, last = run(Elsewhere(proposed=astray), particles=100, seed=0)
    assert len(last.info.exponents) >= 1
    precision = PRIOR**-2 + len(SEEN) / NOISE**2
    off = (last.belief.mean[:3] - SEEN.sum(dim=0) / NOISE**2 / precision) * precision.sqrt()
    assert float(off.abs().max()) < 1.0
    assert last.info.log_evidence == pytest.approx(evidence(), abs=1.5)


def test_a_density_that_is_not_a_number_stops_the_run_and_is_not_tempered_over() -> None:
    class Broken(NormalPose):
        def log_prob(self, value: Tensor) -> Tensor:
            return super().log_prob(value) * math.nan

    broken = Broken(poses.identity(), torch.diag(PRIOR**2), SLIDING)
    with pytest.raises(NotANumberError, match=r"^sight 1: .* nan"):
        list(run(Elsewhere(proposed=broken), particles=20, seed=0))


def test_a_model_without_sensors_and_numbers_out_of_range_are_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="needs a scene with a prior and sensors") as caught:
        list(infer(MODEL, RECORDING))
    assert_one_sentence(str(caught.value))
    for numbers in ({"particles": 0}, {"sweeps": 0}, {"threshold": 1.5}):
        with pytest.raises(InputError):
            infer(MODEL, RECORDING, **numbers)


def unrelated(scene: Any, actions: Sequence[Any]) -> None:
    part = pyro.sample("part", NormalPose(poses.identity(), torch.diag(PRIOR**2), SLIDING))
    for k in range(len(actions)):
        pyro.sample(f"seen_{k}", dist.Normal(torch.full_like(part[:, :3], 0.01), NOISE).to_event(1))


class Far(Exact):
    """Every measurement is made far from the part."""

    def is_far(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> bool:
        return True


@pytest.mark.parametrize(("start", "stays"), [(Far, True), (Exact, False)])
def test_what_all_particles_explain_alike_moves_none_only_far_from_the_part(
    start: type[Exact], stays: bool
) -> None:
    """Near it all may explain it badly. Its evidence counts."""
    count = 20
    model = Model(unrelated, lambda recording: None, observe, "part")
    step = guided(lambda scene: start(), WIDER, kernel("part", lambda approximation: ()))
    first, *_, last = smc(model, RECORDING, step=step, particles=count, seed=0)
    assert torch.equal(first.belief.world_from_part, last.belief.world_from_part) == stays
    if stays:
        expected = float(dist.Normal(0.01, NOISE).log_prob(SEEN).sum())
        assert last.info.log_evidence == pytest.approx(expected)


# ---------------------------------------------------------------- look_and_touch


@functools.cache
def recording() -> Recording:
    """A scene of the bench, probed by a plan laid out at the truth; a prior of a few millimetres."""
    scene = bench_scene(7)
    truth = torch.from_numpy(scene.truth)
    certain = Belief(truth.expand(4, 7).clone(), torch.zeros(4, dtype=torch.float64))
    whole = scene.probe(three_two_one(certain, scene.part, scene.peg))
    near = poses.retract(truth, torch.tensor([1e-3, -2e-3, 1e-3, 0.01, -0.01, 0.02]).double()).numpy()
    return replace(whole, guess=Guess(near, np.full(3, 0.005), 0.03, 0.06))


def some(*which: int) -> Recording:
    return replace(recording(), measurements=[recording().measurements[k] for k in which])


VIEW, TOUCH, TOUCHES = 0, tuple(range(2, 9)), tuple(range(2, 14))


def test_the_same_seed_gives_the_same_belief_to_the_bit() -> None:
    one, other = (
        list(infer(look_and_touch.model, some(VIEW, *TOUCH), particles=6, seed=4))[-1] for _ in range(2)
    )
    assert torch.equal(one.belief.world_from_part, other.belief.world_from_part)
    assert torch.equal(one.belief.log_weights, other.belief.log_weights)
    assert one.info.log_evidence == other.info.log_evidence


@pytest.mark.long
def test_the_backward_kernel_leads_back_to_where_the_forward_kernel_came_from() -> None:
    """Two cameras, then touches."""
    steps = run_checked(look_and_touch.model, some(VIEW, 1, *TOUCH), particles=6)
    assert len(steps) == 10 and all(math.isfinite(s.info.log_evidence) for s in steps)


@pytest.mark.long
def test_a_second_camera_after_a_touch_is_assimilated() -> None:
    *_, last = infer(look_and_touch.model, some(VIEW, *TOUCH, 1), particles=6, seed=0)
    assert last.taken == 9


@pytest.mark.long
def test_a_first_camera_after_touches_is_assimilated() -> None:
    *_, last = infer(look_and_touch.model, some(*TOUCH, VIEW), particles=6, seed=0)
    assert last.taken == 8 and math.isfinite(last.info.log_evidence)


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_touches_alone_place_the_part(seed: int) -> None:
    """The top, one side and the next, no image."""
    *_, last = infer(look_and_touch.model, some(*TOUCHES), particles=20, seed=seed)
    truth = torch.as_tensor(recording().truth)
    off = poses.local(last.belief.mean, truth)
    assert set(last.population.trace.choices) == {"part"}
    # The grasp leaves a millimetre along each axis.
    assert float(off[:3].norm()) < 0.0015 and float(off[3:].norm()) < 0.01
    guess = poses.local(torch.from_numpy(recording().guess.world_from_part), truth)
    assert float(guess[:3].norm()) > 0.002
    # The 99.9 % quantile of six degrees of freedom.
    assert float(off @ torch.linalg.solve(last.belief.covariance, off)) < 22.5


def test_touches_of_a_probe_that_was_tared_amid_it_say_nothing() -> None:
    """The first of its stamps that are there are of a contact, and would be taken for the wrench's zero."""
    with pytest.warns(RuntimeWarning, match="leaves out stamps 0 to 300"):
        first, *_, last = infer(look_and_touch.model, some(*range(8, 14)), particles=6, seed=0)
    assert last.taken == 6 and torch.equal(last.belief.world_from_part, first.belief.world_from_part)


def test_free_windows_alone_keep_the_prior() -> None:
    """Where the peg passed far above the part they carry no information, and the evidence is 1."""
    *_, last = infer(look_and_touch.model, some(2, 3), particles=30, seed=0)
    assert last.info.log_evidence == pytest.approx(0.0, abs=0.1)
    assert last.belief.distinct == 30


def test_windows_and_no_peg_and_pushes_are_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="probe windows but no peg") as caught:
        look_and_touch.prepare(replace(some(*TOUCH), peg=None))
    assert_one_sentence(str(caught.value))
    with pytest.raises(InputError, match="gap_noise = 0"):
        look_and_touch.prepare(some(*TOUCH), gap_noise=0.0)
    # Without windows no peg is needed.
    assert "window" not in look_and_touch.prepare(replace(some(VIEW), peg=None)).likelihoods


def test_moves_leave_the_exact_posterior_as_it_is() -> None:
    torch.manual_seed(0)
    observed = {f"seen_{k}": SEEN[k] for k in range(3)}
    trace = generate(sliding, (None, [None] * 3), observed, 2000)[0]
    exact = Exact(3, SEEN.sum(dim=0))
    drawn = exact.posterior(1.0).sample((2000,))
    population = Population(trace.at({"part": drawn}), torch.zeros(2000).double(), approximation=exact)
    move = kernel("part", lambda approximation: [redrawn(approximation.posterior(1.5))])(population)
    moved, _ = move(population.trace, POSTERIOR)
    for power in (1, 2):
        before, after = (t["part"][:, :3] ** power for t in (trace.at({"part": drawn}), moved))
        error = (before.var(dim=0) / 2000 + after.var(dim=0) / 2000).sqrt()
        assert bool(((before.mean(dim=0) - after.mean(dim=0)).abs() < 4 * error).all())
    assert not torch.equal(moved["part"], drawn)
