"""SMCP3: particles moved by a pair of probabilistic programs and weighted for whatever these chose.

Lew, Matheos, Zhi-Xuan, Ghavamizadeh, Gothoskar, Russell and Mansinghka, SMCP3: Sequential Monte Carlo with
probabilistic program proposals, AISTATS 2023. The forward program chooses at random how to move a particle,
the backward program how it was moved; each returns the choices of the other that undo it. The weight of a
move is p(new) L(backward choices | new) |det J| / (p(old) K(forward choices | old)), with J the Jacobian of
the map from (old values, forward choices) to (new values, backward choices) (theorem 2 of the paper), in the
coordinates of the densities' base measures (`bcppl.inference.kernels.jacobian`). With fixed programs the
estimate of the evidence is unbiased, unless the backward program chooses values that are impossible given
other latent values: limits that are the same for all particles are seen to
(`bcppl.inference.filters.conditioned_backward`).

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
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.conditioned_backward import log_conditioned
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo, Stepped
from bcppl.inference.kernels.halving import apart_from, moved_together
from bcppl.inference.kernels.jacobian import (
    Key,
    charted,
    log_abs_det_jacobian,
    refuse_apart,
    refuse_leaving,
    refuse_unequal,
)
from bcppl.inference.kernels.kernel import scattered, weighted
from bcppl.inference.population import Population
from bcppl.inference.proposals import Fittable, Proposal, program_of
from bcppl.inference.resampling import Resample, adaptive, refuse_no_resampling
from bcppl.traces import Program, Trace, Update, extend, simulate, update
from bcppl.traces.anticipated import Anticipated
from bcppl.traces.differentiation.programs import result_with_grad, with_gradients
from bcppl.traces.series import SeriesTrace
from bcppl.traces.values import Values
from bcppl.traces.verbs import assessed

OLD, FORWARD, NEW, BACKWARD = "old value", "forward choice", "new value", "backward choice"


@dataclass(frozen=True)
class Pair:
    """A forward and a backward program, each `program(trace)` or one that learns (`Fittable`).

    The forward program returns (new values of latent addresses, choices of the backward program); the
    backward program (old values, choices of the forward program), so that one undoes the other. Latent
    addresses that are left out keep their values. What is returned is differentiated, so it is computed in
    torch; a tensor that is returned as it is costs nothing.

    A program that returns no such pair is read as one for `metropolis_hastings`: its choices at latent
    addresses are new values, in whose place the other program chooses the old ones, and its other choices
    are the other program's too. So `Pair(drift("x"), drift("x"))` is a pair.

    Attributes:
        forward: reads the old trace, together with the new measurement if there is one
            (`bcppl.traces.anticipated.Anticipated`). It may choose values of the latent addresses that come
            with the measurement; the others are sampled from the model. The earlier steps of a `Series` stay
            as they are: all that it chooses is new.
        backward: reads the new trace.
        check: check, at every move, that the backward program undoes the forward one, that the Jacobians of
            both cancel, and that particles are not mixed.
        inside: whether the backward program is known to choose what priors with limits allow. Otherwise it is
            conditioned on that (`bcppl.inference.filters.conditioned_backward`).
    """

    forward: Proposal
    backward: Proposal
    check: bool = False
    inside: bool = False


def move_and_weight(
    population: Population,
    pair: Pair,
    observed: Observed | None = None,
    ratio: Callable[[Update], Tensor] = attrgetter("log_ratio"),
) -> Population:
    """The population moved by a pair, given a measurement if there is one, and weighted for it.

    Without a measurement the target stays. A program that learns is fitted to the other half of the
    population.

    Args:
        population: of N particles.
        pair: of programs.
        observed: the measurement.
        ratio: of the target, (N,) log, of what is changed; another than the program's weights for another.

    Raises:
        InputError: a program gives an address that the other has not, more coordinates
            than it takes, or (checked) the programs do not undo each other.
        InferenceError: no particle has any weight left.
    """
    count = len(population)
    learns = isinstance(pair.forward, Fittable) or isinstance(pair.backward, Fittable)
    population, parts = moved_together(population, learning=learns)
    log_factor = torch.zeros(count, dtype=torch.float64)
    whole: Trace | None = None
    for mine in parts:
        forward, backward = _fitted(pair, apart_from(population, mine) if learns else population)
        old = population.trace[mine]
        trace, gained = moved_trace(forward, backward, old, observed, pair.check, ratio)
        if not (pair.inside or (observed is not None and isinstance(old, SeriesTrace))):
            gained = gained + log_conditioned(backward, old, trace, old.choices, _old_values)
        log_factor[mine] = gained
        if whole is None:
            index = torch.zeros(count, dtype=torch.int64)
            index[mine] = torch.arange(len(mine))
            whole = trace if len(parts) == 1 else trace[index]
        else:
            whole = scattered(whole, mine, trace)
    assert whole is not None
    return population.with_trace(whole).reweighed(log_factor)


def smcp3(pair: Pair, *, resample: Resample | None = None) -> StepFunction:
    """A step that assimilates a measurement by a pair of programs: move, weight, resample when needed.

    Args:
        pair: proposes new values for old latent addresses and for those that come with the measurement.
        resample: when and how; by default systematic below half the effective sample size.

    Returns:
        The step. It raises what `move_and_weight` raises.
    """
    resample = adaptive() if resample is None else resample
    refuse_no_resampling("smcp3", resample)

    def step(population: Population, observed: Observed) -> Stepped:
        updated = move_and_weight(population, pair, observed)
        resampled, ancestors = resample(updated)
        info = StepInfo(
            resampled=int(ancestors is not None),
            effective_sample_size_before=updated.effective_sample_size,
            effective_sample_size=resampled.effective_sample_size,
            log_evidence=resampled.log_evidence - population.log_evidence,
            ancestors=ancestors,
        )
        return Stepped(resampled, info)

    return step


def _fitted(pair: Pair, others: Population) -> tuple[Program, Program]:
    others = weighted(others)
    forward = program_of(pair.forward, (), others)
    # What is learned at random must be the same in both.
    return forward, forward if pair.backward is pair.forward else program_of(pair.backward, (), others)


def moved_trace(
    forward: Program,
    backward: Program,
    old: Trace,
    observed: Observed | None = None,
    check: bool = False,
    ratio: Callable[[Update], Tensor] = attrgetter("log_ratio"),
) -> tuple[Trace, Tensor]:
    """Particles moved by two programs, with a measurement if there is one, and their log factors (N,)."""
    count = old.particles
    shown = old if observed is None else Anticipated(old, *observed)
    # The next step of a series begins from the values of the last, which stay.
    latent: Values = {} if observed is not None and isinstance(old, SeriesTrace) else old.choices
    chosen = simulate(forward, (shown,), count)
    refuse_observed_choices("forward", chosen.choices, shown)
    values, back = _read(
        chosen.result, chosen.choices, latent, lambda: shown.brought if isinstance(shown, Anticipated) else []
    )
    new, log_ratio = _updated(old, values, observed, ratio)
    fresh = [a for a in values if a not in latent]
    reverse = assessed(backward, (new,), back, count)
    refuse_observed_choices("backward", reverse.choices, new)
    inputs = charted(OLD, latent, old.distributions)
    for address, value in values.items():
        if address in latent:
            refuse_leaving(address, inputs[OLD, address].chart, latent[address], value)
    inputs |= charted(FORWARD, chosen.choices, chosen.distributions)
    outputs = charted(NEW, {a: new[a] for a in (*latent, *fresh)}, new.distributions)
    outputs |= charted(BACKWARD, back, reverse.distributions)

    def again(point: dict[Key, Tensor]) -> dict[Key, Tensor]:
        before = {a: point[OLD, a] for a in latent}
        choices = {a: point[FORWARD, a] for a in chosen.choices}
        attached = with_gradients(old, before)
        read = attached if observed is None else Anticipated(attached, *observed)
        result = result_with_grad(forward, (read,), choices, count)
        after, returned = _read(result, choices, before, lambda: fresh)
        return {(NEW, a): v for a, v in {**before, **after}.items()} | {
            (BACKWARD, a): v for a, v in returned.items()
        }

    log_jacobian = log_abs_det_jacobian(again, inputs, outputs, check=check)
    if check:
        before, choices = _read(reverse.result, reverse.choices, {a: new[a] for a in latent}, list)
        if not isinstance(reverse.result, tuple):
            choices = {**choices, **{a: new[a] for a in fresh}}
        refuse_other_choices(chosen.choices, choices)
        undone = {(OLD, a): before.get(a, new[a]) for a in latent}
        refuse_apart("the backward program", inputs, undone | {(FORWARD, a): v for a, v in choices.items()})

        def undo(point: dict[Key, Tensor]) -> dict[Key, Tensor]:
            after = {a: point[NEW, a] for a in (*latent, *fresh)}
            made = {a: point[BACKWARD, a] for a in back}
            result = result_with_grad(backward, (with_gradients(new, after),), made, count)
            given, returned = _read(result, made, {a: after[a] for a in latent}, list)
            returned = returned if isinstance(result, tuple) else {**after, **returned}
            return {(OLD, a): given.get(a, after[a]) for a in latent} | {
                (FORWARD, a): returned[a] for a in chosen.choices
            }

        refuse_unequal("a pair", log_jacobian, log_abs_det_jacobian(undo, outputs, inputs), inputs)
    log_chosen = chosen.log_prob()
    log_factor = log_ratio + reverse.log_prob() - log_chosen + log_jacobian
    # A choice without density has left the range of its type (see `metropolis_hastings`).
    return new, torch.where(log_chosen == -torch.inf, -torch.inf, log_factor)


def _updated(
    old: Trace, values: Values, observed: Observed | None, ratio: Callable[[Update], Tensor]
) -> tuple[Trace, Tensor]:
    """The trace at new values, with a measurement if there is one, and its log ratio (N,)."""
    if observed is None:
        updated = update(old, values)
    elif isinstance(old, SeriesTrace):
        return extend(old, observed.args, observed.observations, values)
    else:
        updated = update(old, values, args=observed.args, observations=observed.observations)
    return updated.trace, ratio(updated)


def _old_values(chosen: Trace, latent: Values) -> Values:
    """The old values that a backward program has chosen."""
    return _read(chosen.result, chosen.choices, latent, list)[0]


def refuse_observed_choices(which: str, choices: Values, seen: Trace | Anticipated) -> None:
    """Refuse a program of a pair that samples where something is observed."""
    for address in choices:
        if address in seen.observations:
            raise InputError(
                f"the {which} program of a pair samples {address!r}, which is observed; sample at latent "
                "addresses, and give other choices names of their own."
            )


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
    brought = set(fresh()) if any(a not in latent for a in choices) else set()
    new = {a: v for a, v in choices.items() if a in latent or a in brought}
    # A value that comes with a measurement vanishes with it: the other program need not choose it.
    return new, {a: latent.get(a, v) for a, v in choices.items() if a not in brought}


def refuse_other_choices(forward: Values, returned: Values) -> None:
    """Refuse a backward program that returns other choices than the forward program makes."""
    wrong = sorted(set(forward).symmetric_difference(returned))
    if wrong:
        raise InputError(
            f"a backward program {'leaves out' if wrong[0] in forward else 'gives'} the forward choice "
            f"{wrong[0]!r}; the forward program chooses {', '.join(sorted(forward)) or 'nothing'}."
        )
