"""A population that is saved and loaded goes on as it would have, to the bit, here and in another process."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
import torch

from bcppl.errors import InputError
from bcppl.inference import importance_sampling, saved
from bcppl.inference.saved import plain
from bcppl.inference.series import marginal
from tests.inference.saved.saved_programs import KEPT, bits
from tests.inference.series.linear_series import AUTOREGRESSION, observed


def assert_equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    assert list(first) == list(second)
    assert [name for name in first if not torch.equal(first[name], second[name])] == []


SEEDS = (1, 2, 3)


@pytest.mark.long
def test_in_another_process_it_goes_on_as_here(tmp_path: Path) -> None:
    expected = {}
    for name, kept in KEPT.items():
        for seed in SEEDS:
            population = kept.begun(seed)
            saved.save(population, tmp_path / f"{name}-{seed}.h5")
            expected[f"{name}-{seed}"] = bits(kept.later(kept.later(population)))
    command = [sys.executable, "-m", "tests.inference.saved.saved_programs", *expected, str(tmp_path)]
    # Sums over several threads round differently than over others.
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    subprocess.run(command, check=True, cwd=Path(__file__).parents[3], env=environment)
    for name, there in expected.items():
        assert_equal(there, torch.load(tmp_path / f"{name}.pt"))


@pytest.mark.parametrize("name", KEPT)
def test_what_is_loaded_is_what_was_saved(name: str, tmp_path: Path) -> None:
    population = KEPT[name].begun(4)
    saved.save(population, tmp_path / "p.h5")
    state = torch.get_rng_state()
    again = saved.load(tmp_path / "p.h5", KEPT[name].program)
    assert torch.equal(torch.get_rng_state(), state)
    assert again.trace.known.keys() == population.trace.known.keys()
    assert again.trace.particles == population.trace.particles
    assert again.__dict__.get("effective_sample_size") == population.__dict__.get("effective_sample_size")
    before = bits(population)
    torch.set_rng_state(saved.random_state(tmp_path / "p.h5"))
    assert_equal(before, bits(again))


@pytest.mark.parametrize(("name", "address"), [("groups", "mean"), ("series", "x"), ("chosen", "x")])
def test_log_probabilities_are_not_evaluated_again(name: str, address: str, tmp_path: Path) -> None:
    """In other batches they would round otherwise: here one is marked."""
    population = KEPT[name].begun(5)
    population.trace.log_prob(address)
    population.trace.known[address][7] = -123.0
    saved.save(population, tmp_path / "p.h5")
    again = saved.load(tmp_path / "p.h5", KEPT[name].program)
    assert float(again.trace.log_prob(address)[7]) == -123.0


def test_strides_are_kept_because_sums_round_by_them(tmp_path: Path) -> None:
    torch.manual_seed(0)
    value = torch.randn(50, 300, dtype=torch.float64).mT
    population = KEPT["groups"].begun(6)
    kept = replace(population.trace, args=(1, value, value.expand(2, 300, 50), value[::7, 3:40]))
    content = plain.plain(kept.args)
    with h5py.File(tmp_path / "p.h5", "w") as file:
        plain.write(file, {"args": content})
    with h5py.File(tmp_path / "p.h5") as file:
        (_, *values) = plain.read(file)["args"]
    assert not torch.equal(value.sum(0), value.contiguous().sum(0))
    for one, other in zip(kept.args[1:], values, strict=True):
        assert torch.equal(one.sum(-2), other.sum(-2)) and one.stride() == other.stride()


def test_several_populations_are_in_one_file(tmp_path: Path) -> None:
    populations = [KEPT["series"].begun(seed) for seed in (1, 2)]
    saved.save(populations, tmp_path / "p.h5")
    again = saved.load_several(tmp_path / "p.h5", KEPT["series"].program)
    assert [torch.equal(a.trace["x"], b.trace["x"]) for a, b in zip(populations, again, strict=True)] == [
        True
    ] * 2
    with pytest.raises(InputError, match="holds 2 populations; use `load_several`"):
        saved.load(tmp_path / "p.h5", KEPT["series"].program)


def test_what_filters_estimate_at_random_is_not_saved(tmp_path: Path) -> None:
    walk = marginal(AUTOREGRESSION, "rho", observed="y", particles=3)
    population = importance_sampling(walk, ([()] * 2,), observed(2), 10)
    with pytest.raises(InputError, match="by the filters of y, cannot be saved"):
        saved.save(population, tmp_path / "p.h5")
    assert not (tmp_path / "p.h5").exists()
