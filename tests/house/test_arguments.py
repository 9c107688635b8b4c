"""Numbers, indices, weights and addresses that cannot be are refused in a sentence that states what to do."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, seed_number, whole_number
from bcppl.distributions.poses import SwingTwistPose, UniformPose
from bcppl.errors import InputError
from bcppl.inference.chains import markov_chains
from bcppl.inference.filters.smcp3 import Pair, move_and_weight, smcp3
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.filters.waste_free import waste_free_moves
from bcppl.inference.importance import generate_stratified, importance_sampling
from bcppl.inference.kernels import (
    delayed_acceptance,
    hmc,
    metropolis_hastings,
    mixture,
    moved_by,
    repeat,
    student_t,
    until,
)
from bcppl.inference.population import Population
from bcppl.inference.proposals import (
    Continuous,
    differential_evolution,
    drift,
    independent,
    rotations,
    symmetry,
)
from bcppl.inference.repetitions import repeated
from bcppl.inference.resampling import adaptive, systematic
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Series, Trace, extend, generate, simulate


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def program() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("y", dist.Normal(x, 1.0))


SEEN = {"y": number(0.3)}
WALK = metropolis_hastings(drift("x"))


def population(particles: int = 5) -> Population:
    torch.manual_seed(0)
    return importance_sampling(program, (), SEEN, particles)


NONE = (0, -1, 1.5, math.nan, "many", None, True)
COUNTS: dict[str, Callable[[Any], Any]] = {
    "sweeps": lambda n: tempered(WALK, sweeps=n),
    "most": lambda n: until(displacement=0.5, most=n),
    "times": lambda n: repeat(WALK, n),
    "leapfrog steps": lambda n: hmc("x", steps=n),
    "chains": lambda n: waste_free_moves(WALK, n),
    "moves": lambda n: markov_chains(WALK, population(), n),
    "every": lambda n: markov_chains(WALK, population(), 3, every=n),
    "runs": lambda n: repeated(lambda seed: population(), n),
    "jobs": lambda n: repeated(lambda seed: population(), 1, jobs=n),
    "particles": lambda n: importance_sampling(program, (), SEEN, n),
    "order": rotations,
    "candidates": lambda n: generate_stratified(program, (), SEEN, 4, candidates=n),
    "stages": lambda n: delayed_acceptance(WALK, stages=n),
}


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_that_is_no_whole_number_is_refused(name: str) -> None:
    for wrong in NONE:
        with pytest.raises(InputError, match="whole number"):
            COUNTS[name](wrong)


NUMBERS: dict[str, tuple[Callable[[Any], Any], tuple[Any, ...]]] = {
    "threshold": (lambda v: adaptive(threshold=v), (-0.1, 1.1)),
    "waste-free threshold": (lambda v: waste_free_moves(WALK, 2, threshold=v), (-0.1,)),
    "share": (lambda v: tempered(WALK, share=v), (-0.1, 1.0)),
    "exponent": (lambda v: Target({"y": v}), (-1.0,)),
    "fixed exponent": (lambda v: tempered(WALK, exponents=[0.1, v, 1.0]), ()),
    "displacement": (lambda v: until(displacement=v), (0.0, 2.0)),
    "step size": (lambda v: hmc("x", step_size=v), (0.0,)),
    "jitter": (lambda v: hmc("x", jitter=v), (-0.1, 1.0)),
    "smallest scale": (lambda v: drift("x", (v, 1.0)), (0.0, -1.0, 2.0)),
    "largest scale": (lambda v: drift("x", (0.1, v)), (0.0, 0.05)),
    "inflation": (lambda v: independent("x", inflation=v), (0.0,)),
    "chance": (lambda v: independent("x", wide=(v, 2.0)), (0.0, 1.0)),
    "noise": (lambda v: differential_evolution("x", noise=v), (-1.0,)),
    "jumps": (lambda v: differential_evolution("x", jumps=v), (-0.1, 1.1)),
    "degrees": (lambda v: student_t("x", v), (0.0,)),
    "spread": (lambda v: symmetry("x", rotations(2), spread=(v, 0.1)), (0.0,)),
    "turn": (lambda v: Continuous(turn=v), (-0.1, 4.0)),
    "slide": (lambda v: Continuous(slide=v), (-0.1,)),
    "angle": (lambda v: UniformPose(poses.identity(), 0.1, v), (-0.1, 4.0)),
    "tilt": (lambda v: SwingTwistPose(poses.identity(), 0.1, v, 0.1), (-0.1, 4.0)),
    "yaw": (lambda v: SwingTwistPose(poses.identity(), 0.1, 0.1, v), (-0.1, 4.0)),
    "half width": (lambda v: UniformPose(poses.identity(), v, 0.1), (-0.1,)),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_out_of_range_is_refused(name: str) -> None:
    make, wrong = NUMBERS[name]
    for value in (*wrong, math.nan, math.inf, "a"):
        with pytest.raises(InputError, match="; give"):
            make(value)


def test_what_counts_as_a_number() -> None:
    assert [whole_number("{}", n) for n in (3, np.int64(3), torch.tensor(3))] == [3, 3, 3]
    assert number_within("{}", torch.tensor(0.5), above=0.0, most=0.5) == 0.5
    with pytest.raises(InputError, match=r"^the seed is -1; give a whole number, from 0 to"):
        seed_number(-1)
    for wrong in (-1, 0.5, 2**64, "a"):
        with pytest.raises(InputError, match="the seed is"):
            repeated(lambda seed: population(), 1, wrong)


def test_a_scheme_in_place_of_a_resampling_is_refused() -> None:
    for make in (
        lambda r: tempered(WALK, resample=r),
        lambda r: smcp3(Pair(drift("x"), drift("x")), resample=r),
    ):
        with pytest.raises(InputError, match="given systematic as resample, which does not define when"):
            make(systematic)


# ---- indices


def series_trace() -> Trace:
    def step(x: Tensor) -> Tensor:
        return pyro.sample("x", dist.Normal(x, 1.0))

    series = Series(lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)), step)
    return extend(simulate(series, (), 5), (), {})[0]


@pytest.mark.parametrize("make", [lambda: population().trace, series_trace, population])
def test_particles_are_indexed_as_the_entries_of_a_tensor(make: Callable[[], Any]) -> None:
    one = make()
    for wrong in ([True, False], [0, 5], -6, torch.tensor([0.5])):
        with pytest.raises(IndexError):
            one[wrong]
    for right in (
        [0, 4],
        torch.tensor([-5, -1]),
        (0, 4),
        np.array([0, 4]),
        slice(0, 5, 4),
        [True, False, False, False, True],
    ):
        assert torch.equal(one[right]["x"], one["x"][[0, 4]])


def test_ancestors_and_traces_that_do_not_fit_are_refused() -> None:
    for wrong in ([5], [0.5]):
        with pytest.raises(InputError, match=r"ancestors that are no particles .* from 0 to 4"):
            population().selected(torch.tensor(wrong))
    with pytest.raises(InputError, match="with no particle"):
        population().selected(torch.tensor([], dtype=torch.int64))
    with pytest.raises(InputError, match="a population of 5 particles is given a trace of 3"):
        population().with_trace(population(3).trace)
    for step in (0.5, "last"):
        with pytest.raises(InputError, match=r"step .* of a series was asked for"):
            series_trace()["x", step]


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (torch.zeros(4), r"5 particles is given log weights of shape \(4,\)"),
        (torch.zeros(5, 1), r"shape \(5, 1\)"),
        (
            torch.tensor([0.0, math.nan, 0.0, math.inf, 0.0]),
            r"log weight nan for 2 of 5 particles \(first: 1, 3",
        ),
        (torch.zeros(5, dtype=torch.complex128), "one real number for each"),
    ],
)
def test_weights_that_cannot_be_are_refused(weights: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Population(population().trace, weights)
    with pytest.raises(InputError, match=message):
        Population(population().trace, weights, log_evidence=0.0)


def test_weights_of_another_type_are_made_float64() -> None:
    for kind in (torch.float32, torch.int64):
        assert Population(population().trace, torch.zeros(5, dtype=kind)).log_weights.dtype == torch.float64


# ---- addresses


def test_an_exponent_for_no_site_is_refused() -> None:
    for kernel in (WALK, hmc("x")):
        with pytest.raises(InputError, match=r"gives site 'z' an exponent, but the program never visits it"):
            moved_by(population(), kernel, Target({"z": 0.5}))


def test_an_observed_address_is_not_for_a_proposal() -> None:
    def both(trace: Trace) -> None:
        pyro.sample("x", dist.Normal(trace["x"], 1.0))
        pyro.sample("y", dist.Normal(trace["x"], 1.0))

    with pytest.raises(InputError, match="a proposal samples 'y', which is observed"):
        moved_by(population(), metropolis_hastings(both), POSTERIOR)
    with pytest.raises(InputError, match="the forward program of a pair samples 'y', which is observed"):
        move_and_weight(population(), Pair(both, both))


def test_several_poses_at_one_address_are_refused_at_once() -> None:
    def in_a_plate() -> None:
        with pyro.plate("parts", 3):
            pyro.sample("pose", UniformPose(poses.identity(), 0.1, 0.2))

    def in_an_event() -> None:
        pyro.sample("pose", UniformPose(poses.identity(), 0.1, 0.2).expand([3]).to_event(1))

    def asked(make: Callable[[], Any]) -> None:
        with pytest.raises(InputError, match=r"'pose' samples poses of shape \(3, 7\) for each particle"):
            make()

    for several in (in_a_plate, in_an_event):
        asked(lambda several=several: generate(several, (), {}, 4))
        drawn = Population(simulate(several, (), 4), torch.zeros(4))
        asked(lambda drawn=drawn: moved_by(drawn, metropolis_hastings(drift("pose")), POSTERIOR))
        asked(lambda drawn=drawn: drawn.belief("pose"))
    # What is measured of poses may come several at a time.
    measured = simulate(in_a_plate, (), 1)["pose"][0]
    assert generate(in_a_plate, (), {"pose": measured}, 4)[1].shape == (4,)


def test_an_observation_may_be_written_to_again() -> None:
    place = number(0.3)
    trace, log_weight = generate(program, (), {"y": place}, 4)
    place.fill_(9.0)
    assert float(trace["y"]) == 0.3
    assert torch.equal(trace[[0, 1]].at({"x": trace["x"][:2]}).log_prob("y"), log_weight[:2])


# ---- what is printed


def test_prints_say_addresses_and_shapes_and_no_numbers() -> None:
    start = population(50)
    chains = markov_chains(mixture([WALK]), start, 7, progress=False)
    assert repr(start.trace) == "Trace(50 particles, latent: x (50,), observed: y ())"
    assert repr(chains).startswith("Chains(50 chains, 7 recorded states, acceptance 0.")
    assert "draws: x (7, 50)" in repr(chains) and "tensor" not in repr(chains)
