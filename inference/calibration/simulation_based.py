"""Simulation-based calibration: truth and data are drawn from the joint, and inference is run on the data.

The truth and draws from its posterior are exchangeable, so the truth's rank among L of them is uniform on 0
to L: Talts et al., Validating Bayesian inference algorithms with simulation-based calibration, 2018, theorem
1. It holds for every quantity of latent values and data; the log-likelihood is one that finds errors which no
coordinate shows (Modrak et al., Simulation-based calibration checking for Bayesian computation: the choice of
test quantities shapes sensitivity, Bayesian Analysis, 2023).
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bcppl.arguments import seed_number, whole_number
from bcppl.errors import InferenceError, InputError
from bcppl.inference.arviz import population_of
from bcppl.inference.calibration.joint import Simulator
from bcppl.inference.calibration.quantities import Quantities
from bcppl.inference.calibration.ranks import ranks
from bcppl.inference.calibration.result import Calibration
from bcppl.inference.calibration.rounds import Arrays, gathered, keep, kept
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded, systematic
from bcppl.recordings.hdf5 import replacing
from bcppl.untrusted import strict_json

Inference = Callable[[Any], Any]
SETTINGS = "settings.json"


def calibrate(
    joint: Simulator,
    inference: Inference,
    draws: int,
    *,
    posterior_draws: int = 49,
    seed: int = 0,
    jobs: int = 1,
    folder: str | os.PathLike[str] | None = None,
) -> Calibration:
    """Ranks, coverage and the data-averaged posterior of an inference, over draws of the joint distribution.

    Args:
        joint: what truth and data are drawn from: `Joint(program, args, observed)`, `Recorded(model)`.
        inference: gives, for data (observations by address, or a recording), a population, something that
            has one (a step of SMC), or an iterator over those, of which the last counts. Torch's generator
            is set to a seed before; an inference that takes a seed of its own draws one from it.
        draws: how many truths; 100 find gross errors, 1000 small ones (see the documentation).
        posterior_draws: L, among which each truth is ranked. They are resampled from the weighted particles,
            of which there should be at least twice as many; copies of one particle are too alike, and show.
        seed: of all; torch's own generator is left as it was. More draws continue the same ones.
        jobs: how many rounds at a time: above 1 in so many other processes, of one thread each.
        folder: each round is kept in a file there; a call that was interrupted, or is to have more draws,
            goes on from them. The first of them is made again, to see that it is of this inference.

    Raises:
        InputError: what is given is no joint distribution, a number is out of range, inference gives no
            population or one with other latent addresses, it has fewer particles than `posterior_draws`, or
            the folder is of other settings, or its first round is not what is given would make of it.
        InferenceError: inference fails; names the seed of the round.
    """
    if not hasattr(joint, "draw"):
        raise InputError(
            f"calibrate is given a {type(joint).__name__} in place of a joint distribution; give "
            "Joint(program, args, observed) or Recorded(model) first, and the inference second."
        )
    draws = whole_number("a calibration of {} draws was asked for", draws)
    ranked = whole_number("truths are to be ranked among {} draws", posterior_draws)
    jobs = whole_number("{} rounds at a time were asked for", jobs)
    seeds = [int(s) for s in np.random.SeedSequence(seed_number(seed)).generate_state(draws)]
    path = None if folder is None else _prepared(Path(folder), seed, ranked)
    done = {} if path is None else {k: arrays for k in range(draws) if (arrays := kept(_file(path, k)))}
    missing = [number for number in range(draws) if number not in done]
    job = Round(joint, inference, ranked)
    if done:
        first = min(done)
        _refuse_other(Path(folder or ""), done[first], job(seeds[first]))
    for number, arrays in gathered(job, [seeds[k] for k in missing], min(jobs, max(1, len(missing)))):
        done[missing[number]] = arrays
        if path is not None:
            keep(_file(path, missing[number]), arrays)
    return Calibration.of_rounds([done[number] for number in range(draws)], ranked)


def _refuse_other(folder: Path, there: Arrays, again: Arrays) -> None:
    """Refuse rounds that what is given does not make; another machine may round otherwise."""
    equal = np.array_equal(there["names"], again["names"]) and all(
        there[name].shape == again[name].shape
        and np.allclose(there[name], again[name], rtol=1e-6, equal_nan=True)
        for name in ("truth", "posterior", "ranks")
    )
    if not equal:
        raise InputError(
            f"{folder} holds a calibration of another inference, joint distribution or test quantity, or of "
            "one that does not repeat itself with the same seed; give another folder."
        )


def _file(folder: Path, number: int) -> Path:
    return folder / f"round_{number:06d}.npz"


def _prepared(folder: Path, seed: int, ranked: int) -> Path:
    """The folder, made if it is missing; one of other settings is refused."""
    settings = {"format": "bcppl calibration", "version": 1, "seed": seed, "posterior_draws": ranked}
    path = folder / SETTINGS
    if path.is_file():
        try:
            there = strict_json.read(path, "give another folder")
        except InputError:
            there = None
        if there != settings:
            raise InputError(
                f"{folder} holds a calibration of other settings ({there}); give another folder."
            )
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as beside:
        beside.write_text(json.dumps(settings), encoding="utf-8")
    return folder


@dataclass(frozen=True)
class Round:
    """One truth: drawn, inferred from its data, and ranked. What it gives is arrays, for a file."""

    joint: Simulator
    inference: Inference
    ranked: int

    def __call__(self, seed: int) -> Arrays:
        """The round of a seed."""
        with seeded(seed):
            truth, data = self.joint.draw()
            if not truth:
                raise InputError("a calibration needs a latent value, but every site is observed.")
            quantities = Quantities(self.joint, data, tuple(truth))
            try:
                population = _inferred(self.inference, data)
            except InputError:
                raise
            except InferenceError as error:
                raise type(error)(f"round of seed {seed}: {error}") from error
            except Exception as error:
                what = f"round of seed {seed}: the inference raised {type(error).__name__}: {error}"
                raise InferenceError(what) from error
            return self._ranked(population, truth, quantities)

    def _ranked(self, population: Population, truth: Mapping[str, Any], quantities: Quantities) -> Arrays:
        missing = [address for address in truth if address not in population.trace.choices]
        if missing:
            raise InputError(
                f"the joint has a latent value at {missing[0]!r}, which the population lacks: its latent "
                f"addresses are {', '.join(population.trace.choices) or 'none'}."
            )
        if len(population) < self.ranked:
            raise InputError(
                f"truths are to be ranked among {self.ranked} draws of {len(population)} particles; use more "
                "particles, or fewer `posterior_draws`."
            )
        chosen = systematic(population.log_weights)[torch.randperm(len(population))[: self.ranked]]
        # The truth comes first: one batch, so that all are evaluated alike.
        values = {
            a: torch.cat([value[None].to(population.trace[a]), population.trace[a][chosen]])
            for a, value in truth.items()
        }
        measured = quantities.measured(values)
        columns = torch.stack(list(measured.values()), dim=-1)
        coordinates = columns[:, : len(quantities.scales)]
        return {
            "names": np.array(list(measured)),
            "ranks": ranks(columns[0], columns[1:]).numpy(),
            "truth": coordinates[0].numpy(),
            "posterior": coordinates[1:].numpy(),
            "effective_sample_size": np.array(population.effective_sample_size),
        }


def _inferred(inference: Inference, data: Any) -> Population:
    asked = "an inference that returns one, a step of SMC, or an iterator over those"
    return population_of(inference(data), asked)
