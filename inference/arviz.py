"""Populations in ArviZ's data structure: draws of equal weight, one chain for each independent run."""

from __future__ import annotations

import importlib
import warnings
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.inference.chains import Chains
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded, systematic
from bcppl.inference.summaries import is_angle, is_pose
from bcppl.poses.quaternions import wrapped_angle

POSE_COORDINATES = ("x", "y", "z", "qw", "qx", "qy", "qz")


def to_arviz(runs: Any, *, draws: int | None = None, seed: int = 0) -> Any:
    """Equal-weight draws of every latent address, with their log-likelihoods and sampler statistics.

    The draws are resampled from the weighted particles and put in random order, so copies count as draws;
    `sample_stats` has the effective sample size.

    Args:
        runs: a population, or something that has one, such as a step of SMC; an iterator over steps, of
            which the last counts; or several populations, those of independent runs of one program on the
            same measurements (`repeated(...)`, or a list): the chains. Or `Chains`, whose states are draws
            already: then there is no log_likelihood, and sample_stats has each chain's `acceptance`.
        draws: how many of each; by default as many as the smallest population has particles. Of `Chains` the
            last so many, by default all.
        seed: same seed, same draws; torch's own generator is left as it was.

    Returns:
        An `arviz.InferenceData` with the groups

        - posterior: every latent address, (chain, draw, *event). A pose has its seven numbers along the
          dimension `pose` (x y z in metres, qw qx qy qz), with the sign of each quaternion that is nearer to
          the mean's. An angle is within half a turn of the mean, which is circular.
        - log_likelihood: of every observed address, (chain, draw).
        - sample_stats: (chain, draw) `lp`, the log-probability of all sites; `log_weight`, unnormalised, of
          the drawn particle; `particle`, its index; `founder`, the index of its ancestor in the first
          population. (chain,) `log_evidence`, `effective_sample_size` and `distinct_particles`, the last the
          number of different particles drawn.
        - observed_data: the observations.

    Raises:
        InputError: ArviZ is not installed; no population is given, or they differ in their addresses or
            their observations; or `draws` is below 1.
        NoWeightError: no particle of a population has any weight.
    """
    arviz = import_arviz()
    if isinstance(runs, Chains):
        return _of_chains(arviz, runs, draws)
    chains = _populations(runs)
    check_alike(chains)
    with seeded(seed):
        chosen = draw(chains, draws)
    first = chains[0].trace
    posterior = {
        address: at_draws([chain.trace.choices[address] for chain in chains], chosen)
        for address in first.choices
    }
    log_likelihood = {
        address: at_draws([chain.trace.log_prob(address) for chain in chains], chosen)
        for address in first.addresses
        if address not in first.choices
    }
    sample_stats = {
        "lp": at_draws([chain.trace.log_prob() for chain in chains], chosen),
        "log_weight": at_draws([chain.log_weights for chain in chains], chosen),
        "particle": torch.stack(chosen),
        "founder": at_draws([chain.founders for chain in chains], chosen),
    }
    data = _inference_data(
        arviz, chains[0], posterior, log_likelihood=_numpy(log_likelihood), sample_stats=_numpy(sample_stats)
    )
    data.sample_stats["log_evidence"] = ("chain", [chain.log_evidence for chain in chains])
    sizes = [chain.effective_sample_size for chain in chains]
    data.sample_stats["effective_sample_size"] = ("chain", sizes)
    data.sample_stats["distinct_particles"] = ("chain", [len(torch.unique(index)) for index in chosen])
    return data


def _populations(runs: Any) -> list[Population]:
    """The populations of runs in any of the forms that `to_arviz` accepts."""
    runs = getattr(runs, "populations", getattr(runs, "population", runs))
    if isinstance(runs, Population):
        return [runs]
    if not isinstance(runs, Iterable):
        raise InputError(
            f"a {type(runs).__name__} was given; give a population, a step of SMC, runs or chains."
        )
    given = list(runs)
    each = [population_of(one, "populations, steps of SMC, runs or chains") for one in given]
    # An iterator over the steps of one run; populations are those of several.
    of_one = isinstance(runs, Iterator) and not any(isinstance(one, Population) for one in given)
    return each[-1:] if of_one else each


def population_of(given: Any, asked: str) -> Population:
    """The population that is given, or that what is given has: a step of SMC, or the last of an iterator."""
    if isinstance(given, Iterator):
        last = deque(given, maxlen=1)
        given = last[0] if last else None
    population = getattr(given, "population", given)
    if not isinstance(population, Population):
        raise InputError(f"a {type(given).__name__} was given in place of a population; give {asked}.")
    return population


def _inference_data(arviz: Any, population: Population, posterior: dict[str, Tensor], **groups: Any) -> Any:
    """Draws by address, quaternions with one sign, angles of one turn, the observations, and other groups."""
    posed = [address for address in posterior if is_pose(population, address)]
    for address, values in posterior.items():
        if address in posed:
            posterior[address] = _one_sign(values)
        elif is_angle(population, address):
            posterior[address] = _one_turn(values)
    return arviz.from_dict(
        posterior=_numpy(posterior),
        observed_data=_numpy(population.trace.observations) or None,
        coords={"pose": list(POSE_COORDINATES)} if posed else None,
        dims={address: ["pose"] for address in posed},
        **{name: group or None for name, group in groups.items()},
    )


def _of_chains(arviz: Any, chains: Chains, draws: int | None) -> Any:
    recorded = min((len(states) for states in chains.draws.values()), default=0)
    draws = recorded if draws is None else draws
    draws = whole_number(f"{{}} draws were asked for of chains with {recorded} states", draws, most=recorded)
    last = Population(chains.trace)
    # Chains are recorded move by move.
    posterior = {address: states[-draws:].movedim(1, 0) for address, states in chains.draws.items()}
    acceptance = chains.acceptance[:, None].expand(-1, draws)
    data = _inference_data(arviz, last, posterior, sample_stats=_numpy({"acceptance": acceptance}))
    # A group starts with the values that have both dimensions.
    data.sample_stats["acceptance"] = ("chain", chains.acceptance.numpy())
    return data


def import_arviz() -> Any:
    """The package arviz, imported without its notice about version 1."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arviz = importlib.import_module("arviz")
    except ImportError as error:
        raise InputError("ArviZ is not installed; run `pip install 'bcppl[arviz]'`.") from error
    if not hasattr(arviz, "InferenceData"):
        raise InputError(f"ArviZ {arviz.__version__} is too new; run `pip install 'arviz>=0.23,<1'`.")
    return arviz


def check_alike(populations: Sequence[Population]) -> None:
    """Refuse populations that are not of one program and the same observations."""
    if not populations:
        raise InputError("no population was given; give one or more.")
    first = populations[0].trace
    for number, population in enumerate(populations[1:], start=2):
        trace = population.trace
        if set(trace.choices) != set(first.choices) or set(trace.observations) != set(first.observations):
            raise InputError(
                f"populations 1 and {number} have different addresses ({', '.join(first.addresses)} and "
                f"{', '.join(trace.addresses)}); give runs of one program on the same observations."
            )
        for address, value in first.observations.items():
            if not torch.equal(torch.nan_to_num(value), torch.nan_to_num(trace.observations[address])):
                raise InputError(
                    f"populations 1 and {number} have different observations at {address!r}; "
                    "give runs on the same observations."
                )


def draw(populations: Sequence[Population], draws: int | None) -> list[Tensor]:
    """Indices of equal-weight draws, (draws,) int64 for each population, in random order."""
    draws = min(map(len, populations)) if draws is None else whole_number("{} draws were asked for", draws)
    # Ancestors come in order; draws in order would look like a chain that does not mix.
    return [systematic(population.log_weights, draws)[torch.randperm(draws)] for population in populations]


def at_draws(values: Sequence[Tensor], chosen: Sequence[Tensor]) -> Tensor:
    """Values (N, *event) of each population at its draws, (chain, draw, *event)."""
    return torch.stack([value[index] for value, index in zip(values, chosen, strict=True)])


def _one_sign(world_from_part: Tensor) -> Tensor:
    """Poses (chain, draw, 7), every quaternion with the sign that is nearer to that of their mean."""
    pooled = world_from_part.reshape(-1, 7)
    mean = Belief(pooled, torch.zeros(len(pooled), dtype=torch.float64)).mean[3:]
    mean = mean if float(mean[0]) >= 0 else -mean
    sign = torch.where(pooled[:, 3:] @ mean < 0, -1.0, 1.0)[:, None]
    return torch.cat([pooled[:, :3], sign * pooled[:, 3:]], dim=1).reshape(world_from_part.shape)


def _one_turn(angles: Tensor) -> Tensor:
    """Angles (chain, draw, *event) within half a turn of their mean, where ArviZ's own means are right."""
    middle = torch.atan2(angles.sin().mean(dim=(0, 1)), angles.cos().mean(dim=(0, 1)))
    return middle + wrapped_angle(angles - middle)


def _numpy(values: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {address: value.detach().cpu().numpy() for address, value in values.items()}
