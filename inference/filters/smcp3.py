"""SMCP3: particles moved by a pair of programs, weighed by whatever they chose on the way.

Lew, Matheos, Zhi-Xuan, Ghavamizadeh, Gothoskar, Russell and Mansinghka, SMCP3: Sequential Monte Carlo with
probabilistic program proposals, AISTATS 2023. The forward program chooses at random what to do with a
particle, the backward program what was done; each says what the other has to choose to undo it. The weight of
a move is p(new) L(backward choices | new) |det J| / (p(old) K(forward choices | old)), J that of the map from
(old values, forward choices) to (new values, backward choices) (theorem 2 of the paper), taken in the
coordinates of the densities' base measures (`bcppl.inference.kernels.jacobian`). With fixed programs the
estimate of the evidence stays unbiased.

    def forward(trace):
        shift = pyro.sample("shift", dist.Normal(0.5 * trace["y_3"], 0.2))
        return {"x": trace["x"] + shift}, {"shift back": shift}

    def backward(trace):
        shift = pyro.sample("shift back", dist.Normal(0.5 * trace["y_3"], 0.3))
        return {"x": trace["x"] - shift}, {"shift": shift}

    step = smcp3(Pair(forward, backward))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo, Stepped
from bcppl.inference.kernels.jacobian import (
    Key,
    charted,
    log_abs_det_jacobian,
    refuse_apart,
    refuse_leaving,
)
from bcppl.inference.kernels.kernel import put
from bcppl.inference.population import Population
from bcppl.inference.proposals import Fitted, Program, Proposal, program_of
from bcppl.inference.resampling import Resample, adaptive, check_resample
from bcppl.traces import Trace, extend, simulate, update
from bcppl.traces.anticipated import Anticipated
from bcppl.traces.gradient import result_with_grad, with_gradients
from bcppl.traces.propose import assessed
from bcppl.traces.series import SeriesTrace

OLD, FORWARD, NEW, BACKWARD = "old value", "forward choice", "new value", "backward choice"

Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class Pair:
    """A forward and a backward program, each `program(trace)` or one that learns (`Fitted`).

    The forward program returns (new values of latent addresses, choices of the backward program); the
    backward program (old values, choices of the forward program), so that one undoes the other. Latent
    addresses that are left out keep their values. What is returned is differentiated, so it is computed in
    torch; what is handed on as it is costs nothing.

    A program that returns no such pair is read as one for `metropolis_hastings`: its choices at latent
    addresses are new values, in whose place the other program chooses the old ones, and its other choices
    are the other program's too. So `Pair(drift("x"), drift("x"))` is a pair.

    Attributes:
        forward: reads the old trace, and in it all observations, those of the new measurement too. It may
            choose values of the latent addresses that come with the measurement; the others are drawn from
            the model. The earlier steps of a `Series` stay as they are: all that it chooses is new.
        backward: reads the new trace.
        check: check, at every move, that the backward program leads back to where the forward one came from,
            and that particles are not mixed.
    """

    forward: Proposal
    backward: Proposal
    check: bool = False


def _refuse_no_pair(pair: object) -> None:
    if not isinstance(pair, Pair):
        raise InputError(
            f"SMCP3 is given a {type(pair).__name__} in place of a pair; give Pair(forward, backward)."
        )


def moved(population: Population, pair: Pair) -> Population:
    """Every particle moved by a pair and weighed for it; the target stays.

    Where a program learns, each half of the population learns from the other.

    Raises:
        InputError: no `Pair` is given, a program gives an address that the other has not, more coordinates
            than it takes, or (checked) no way back.
        InferenceError: no particle has any weight left.
    """
    _refuse_no_pair(pair)
    return _by_halves(population, pair, None)


def smcp3(pair: Pair, *, resample: Resample | None = None) -> StepFunction:
    """A step that takes a measurement in by a pair of programs: move, extend, weigh, resample when needed.

    Args:
        pair: proposes new values for old latent addresses and for those that come with the measurement.
        resample: when and how; by default systematic below half the effective sample size.

    Returns:
        The step. It raises what `moved` raises.

    Raises:
        InputError: no `Pair` is given.
    """
    _refuse_no_pair(pair)
    if resample is None:
        resample = adaptive()
    check_resample("smcp3", resample)

    def step(population: Population, observed: Observed) -> Stepped:
        weighed = _by_halves(population, pair, observed)
        resampled, ancestors = resample(weighed)
        info = StepInfo(
            resampled=int(ancestors is not None),
            effective_sample_size_before=weighed.effective_sample_size,
            effective_sample_size=resampled.effective_sample_size,
            log_evidence=resampled.log_evidence - population.log_evidence,
            ancestors=ancestors,
        )
        return Stepped(resampled, info)

    return step


def _by_halves(population: Population, pair: Pair, observed: Observed | None) -> Population:
    """Both halves learn from the other as it was before the move."""
    count = len(population)
    if not isinstance(pair.forward, Fitted) and not isinstance(pair.backward, Fitted):
        parts = [torch.arange(count)]
    else:
        parts = [half for half in torch.randperm(count).tensor_split(2) if len(half)]
    factor = torch.zeros(count, dtype=torch.float64)
    whole: Trace | None = None
    for k, mine in enumerate(parts):
        forward, backward = _fitted(pair, population[parts[1 - k]] if len(parts) > 1 else population)
        trace, gained = moved_trace(forward, backward, population.trace[mine], observed, pair.check)
        factor[mine] = gained
        if whole is None:
            index = torch.zeros(count, dtype=torch.int64)
            index[mine] = torch.arange(len(mine))
            whole = trace if len(parts) == 1 else trace[index]
        else:
            whole = put(whole, mine, trace)
    assert whole is not None
    # A particle without weight stays without: it is not brought back by moving where it could be.
    factor = torch.where(population.log_weights == -torch.inf, 0.0, factor)
    return population.with_trace(whole).reweighed(factor)


def _fitted(pair: Pair, others: Population) -> tuple[Program, Program]:
    if not bool((others.log_weights > -torch.inf).any()):
        others = replace(others, log_weights=torch.zeros_like(others.log_weights))
    forward = program_of(pair.forward, (), others)
    # What is learned at random must be the same both ways.
    return forward, forward if pair.backward is pair.forward else program_of(pair.backward, (), others)


def moved_trace(
    forward: Program, backward: Program, old: Trace, observed: Observed | None = None, check: bool = False
) -> tuple[Trace, Tensor]:
    """Particles moved by two programs, and extended by a measurement if there is one; with log factors (N,).

    Raises:
        InputError: see `moved`.
    """
    count = old.particles
    shown = old if observed is None else Anticipated(old, *observed)
    # The next step of a series begins from the values of the last, which stay.
    latent: Values = {} if observed is not None and isinstance(old, SeriesTrace) else old.choices
    there = simulate(forward, (shown,), count)
    _refuse_observed("forward", there.choices, shown)
    new, back = _read(there.result, there.choices, latent, lambda: _brought(shown))
    reached, log_factor = _reached(old, new, observed)
    fresh = [a for a in new if a not in latent]
    way_back = assessed(backward, (reached,), back, count)
    _refuse_observed("backward", way_back.choices, reached)
    inputs = charted(OLD, latent, old.distributions)
    for address, value in new.items():
        if address in latent:
            refuse_leaving(address, inputs[OLD, address].chart, latent[address], value)
    inputs |= charted(FORWARD, there.choices, there.distributions)
    outputs = charted(NEW, {a: reached[a] for a in (*latent, *fresh)}, reached.distributions)
    outputs |= charted(BACKWARD, back, way_back.distributions)

    def again(values: dict[Key, Tensor]) -> dict[Key, Tensor]:
        before = {a: values[OLD, a] for a in latent}
        chosen = {a: values[FORWARD, a] for a in there.choices}
        attached = with_gradients(old, before)
        looked_at = attached if observed is None else Anticipated(attached, *observed)
        result = result_with_grad(forward, (looked_at,), chosen, count)
        after, returned = _read(result, chosen, before, lambda: fresh)
        return {(NEW, a): v for a, v in {**before, **after}.items()} | {
            (BACKWARD, a): v for a, v in returned.items()
        }

    log_stretch = log_abs_det_jacobian(again, inputs, outputs, check=check)
    if check:
        values, choices = _read(way_back.result, way_back.choices, {a: reached[a] for a in latent}, list)
        if not isinstance(way_back.result, tuple):
            choices = {**choices, **{a: reached[a] for a in fresh}}
        _refuse_other_choices(there.choices, choices)
        found = {(OLD, a): values.get(a, reached[a]) for a in latent}
        refuse_apart("the backward program", inputs, found | {(FORWARD, a): v for a, v in choices.items()})
    chosen = there.log_prob()
    log_factor = log_factor + way_back.log_prob() - chosen + log_stretch
    # What ran out of the numbers of its type (see `metropolis_hastings`) came where nothing leads.
    return reached, torch.where(chosen == -torch.inf, -torch.inf, log_factor)


def _refuse_observed(which: str, choices: Values, seen: Trace | Anticipated) -> None:
    for address in choices:
        if address in seen.observations:
            raise InputError(
                f"the {which} program of a pair samples {address!r}, which is observed; sample at latent "
                "addresses, and give other choices names of their own."
            )


def _reached(old: Trace, new: Values, observed: Observed | None) -> tuple[Trace, Tensor]:
    """The particles at new values and with a measurement, if there is one; with the log ratio (N,)."""
    if observed is not None and isinstance(old, SeriesTrace):
        return extend(old, observed.args, observed.observations, new)
    args, observations = (None, None) if observed is None else observed
    updated = update(old, new, args=args, observations=observations)
    return updated.trace, updated.log_ratio


def _brought(shown: Trace | Anticipated) -> list[str]:
    """The latent addresses that come with a measurement."""
    return shown.brought if isinstance(shown, Anticipated) else []


def _read(
    result: Any, choices: Values, latent: Values, fresh: Callable[[], list[str]]
) -> tuple[Values, Values]:
    """New values and the other program's choices, from what a program returned or else from its choices."""
    if isinstance(result, tuple) and len(result) == 2 and all(isinstance(r, Mapping) for r in result):
        return result
    if isinstance(result, tuple | Mapping):
        raise InputError(
            f"a program of a pair returns a {type(result).__name__} that is no pair of mappings; "
            "return (values by latent address, choices of the other program), or nothing."
        )
    come = set(fresh()) if any(a not in latent for a in choices) else set()
    new = {a: v for a, v in choices.items() if a in latent or a in come}
    # What comes with a measurement goes with it: the other program need not choose it.
    return new, {a: latent.get(a, v) for a, v in choices.items() if a not in come}


def _refuse_other_choices(forward: Values, returned: Values) -> None:
    wrong = sorted(set(forward).symmetric_difference(returned))
    if wrong:
        raise InputError(
            f"a backward program {'leaves out' if wrong[0] in forward else 'gives'} the forward choice "
            f"{wrong[0]!r}; the forward program chooses {', '.join(sorted(forward)) or 'nothing'}."
        )
