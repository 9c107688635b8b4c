"""Whether a program run again at the same values is the same: no randomness, no state, fixed addresses."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import FunctionType
from typing import Any

import numpy as np
import torch
from pyro.distributions import Delta
from torch import Tensor

from bcppl.traces.checks.comparing import Start, first_differing, log_probs, rerun
from bcppl.traces.dependence.equality import alike, equal
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.indexing import indexed
from bcppl.traces.run import run
from bcppl.traces.series import SeriesTrace
from bcppl.traces.trace import Trace

KEEPS_NOTHING = "use nothing that an earlier run leaves behind, no clock, and no random generator of its own"
# Runs in which a program may visit other addresses: a fair choice stays unseen in one of 2^15.
RUNS = 16


@contextmanager
def undisturbed(number: int = 0) -> Iterator[None]:
    """The generators of torch, numpy and Python begin from a seed, and are as before afterwards."""
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()
    try:
        seed(number)
        yield
    finally:
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])
        random.setstate(states[2])


def seed(number: int) -> None:
    """Seed the generators of torch, numpy and Python."""
    torch.default_generator.manual_seed(number)
    np.random.seed(number)
    random.seed(number)


def check_addresses(start: Start, particles: int, args: Any, program: Any) -> None:
    """Check that runs at other values visit the same addresses, and that none seeds the generators.

    Raises:
        ProgramError: they do not (ADDRESSES), unless a run changes what the next one is given (STATE); or
            torch's generator is seeded (RANDOMNESS).
    """
    before, dtype = _Kept.of(args, program), torch.get_default_dtype()
    first, others = start(particles), []
    before.add_arguments(first.args)  # a trace keeps lists of its own
    generators = {torch.get_rng_state().numpy().tobytes()}
    for number in range(RUNS):
        seed(1000 + number)
        others.append(trace := start(particles))
        generators.add(torch.get_rng_state().numpy().tobytes())
        if other := set(trace.addresses) ^ set(first.addresses):
            raise _other_addresses(first, min(other), before)
        if torch.get_default_dtype() != dtype:
            torch.set_default_dtype(dtype)
            raise ProgramError(
                Fault.STATE,
                None,
                "the program sets torch's default type of numbers; set it before it is run.",
            )
    if other := set(first.addresses) ^ set(rerun(first).addresses):
        raise _other_addresses(first, min(other), before)
    if len(generators) == 1:
        raise ProgramError(
            Fault.RANDOMNESS,
            None,
            "the program seeds torch's generator, so that all runs draw the same; seed it before it is run.",
        )
    for address, value in first.choices.items():
        again = all(equal(value, trace.choices[address]) for trace in others)
        if again and value.is_floating_point() and not isinstance(first.distributions[address], Delta):
            spread = bool((value != value[0]).any())
            if spread:
                raise ProgramError(
                    Fault.RANDOMNESS,
                    address,
                    f"site {address!r} is sampled at the same values in every run; let its distribution draw "
                    "from torch's generator, which it does not seed.",
                )


def _other_addresses(first: Trace, site: str, before: _Kept) -> ProgramError:
    """The error of a site that some runs visit and others do not, at the same values or at others alone."""
    visited, generators = set(first.addresses), _generators()
    what = f"site {site!r} is visited in some runs and not in others"
    if any(set(rerun(first).addresses) != visited for _ in range(RUNS)):
        before.refuse_changed(site, what)
        if _generators() != generators:
            sentence = f"{what} at the same values; sample whatever is random by `pyro.sample`."
            return ProgramError(Fault.RANDOMNESS, site, sentence)
        return ProgramError(Fault.STATE, site, f"{what} at the same values; {KEEPS_NOTHING}.")
    return ProgramError(
        Fault.ADDRESSES,
        site,
        f"{what}; sample it always, from its prior, and where it plays no part ignore its value with "
        "`torch.where`, or write a program for each structure.",
    )


def check_reruns(trace: Trace, other: Trace, args: Any, program: Any) -> None:
    """Check that a program, its sites set to the same values, gives the same densities in a new run.

    Args:
        trace: of N particles, evaluated.
        other: of as many, at other values, which the program is run at in between.
        args: the program's arguments.
        program: the program or series itself, whose global variables are looked at.

    Raises:
        ProgramError: a density or the state of a series is another (RANDOMNESS, STATE).
    """
    before, expected = _Kept.of(args, program), log_probs(trace)
    log_probs(rerun(other))
    if (where := first_differing(expected, log_probs(trace))) is not None:
        raise ProgramError(
            Fault.STATE,
            where[0],
            f"the log-probability of site {where[0]!r} is written over when another is evaluated; return a "
            "new tensor each time.",
        )
    generators = _generators()
    again = rerun(trace)
    got = log_probs(again)
    drew = _generators() != generators
    site: str | None = None
    if (where := first_differing(expected, got)) is not None:
        site, particle = where
        what = (
            f"site {site!r} has log-probability {float(got[site][particle]):.6g} in a run at values where it "
            f"had {float(expected[site][particle]):.6g} before"
        )
    elif not _equal_states(trace, again):
        what = "a series' state is another in a run at values that were the same before"
    else:
        _refuse_unrepeatable(again, got)
        return
    if drew:
        raise ProgramError(
            Fault.RANDOMNESS,
            site,
            f"{what}, and the run draws random numbers; sample whatever is random by `pyro.sample`.",
        )
    before.refuse_changed(site, what)
    raise ProgramError(Fault.STATE, site, f"{what}; {KEEPS_NOTHING}.")


def check_values(trace: Trace) -> None:
    """Check that a program, given values of its sites, leaves them as they are.

    Raises:
        ProgramError: it writes into one (OVERWRITTEN).
    """
    given = {address: trace[address] for address in trace.addresses if address in trace}
    for address, distribution in trace.distributions.items():
        if address in trace.structure:
            continue
        with suppress(NotImplementedError):
            plates = len(distribution.batch_shape) - 1
            given[address] = distribution.sample().movedim(plates, 0)
    values = {address: value.clone() for address, value in given.items()}
    run(trace.program, trace.args, trace.particles, values, {})
    for address, value in given.items():
        if not equal(value, values[address]):
            raise ProgramError(
                Fault.OVERWRITTEN,
                address,
                f"the program writes into the value of site {address!r}; compute a new tensor from it "
                "(`x = x + 1`, not `x += 1`).",
            )


def _refuse_unrepeatable(trace: Trace, expected: dict[str, Tensor]) -> None:
    """Refuse log-probabilities that are others when they are evaluated again in the same run."""
    once_more = replace(trace, known={})
    once_more._keep_run(trace._run)
    if (where := first_differing(expected, log_probs(once_more))) is not None:
        raise ProgramError(
            Fault.STATE,
            where[0],
            f"site {where[0]!r} has another log-probability when it is evaluated again; change no attribute "
            "of its distribution, and nothing that this holds, in `log_prob`.",
        )


def _generators() -> list[Any]:
    """The states of the generators of torch, numpy and Python."""
    numpy: Any = np.random.get_state()
    return [torch.get_rng_state().numpy().tobytes(), numpy[1].tobytes(), *numpy[2:], random.getstate()]


def _equal_states(first: Trace, second: Trace) -> bool:
    """Whether the states of two traces of a series are equal up to rounding; other traces have none."""
    if not isinstance(first, SeriesTrace) or not isinstance(second, SeriesTrace):
        return True
    pairs: list[bool] = []

    def compare(a: Any, b: Any) -> bool:
        pairs.append(a.shape == b.shape and np.allclose(np.asarray(a), np.asarray(b), 1e-6, 1e-6, True))
        return True

    every = torch.arange(first.particles)
    one, other = (indexed(each.state, every, each.particles) for each in (first, second))
    alike(one, other, compare)
    return all(pairs)


class _Kept:
    """Copies of what a run might change: arguments, and the global variables that the program reads."""

    def __init__(self, live: dict[str, Any]) -> None:
        self.live, self.copies = live, {name: _copy(value) for name, value in live.items()}

    def add_arguments(self, args: Any) -> None:
        """Look at these arguments too."""
        live = {f"argument {k}": value for k, value in enumerate(args)}
        self.live |= live
        self.copies |= {name: _copy(value) for name, value in live.items()}

    @classmethod
    def of(cls, args: Any, program: Any) -> _Kept:
        live = {f"argument {k}": value for k, value in enumerate(args)}
        for given in (program, getattr(program, "init", None), getattr(program, "step", None)):
            # Of a partial application or a method, the function.
            each = getattr(given, "func", getattr(given, "__func__", given))
            if isinstance(each, FunctionType):
                live[f"the defaults of {each.__name__}"] = each.__defaults__
                for name in each.__code__.co_names:
                    if name in each.__globals__:
                        live[f"the global variable {name!r}"] = _Global(each.__globals__, name)
                cells = zip(each.__code__.co_freevars, each.__closure__ or (), strict=True)
                live.update({f"the variable {name!r}": _Cell(cell) for name, cell in cells})
        return cls(live)

    def refuse_changed(self, site: str | None, what: str) -> None:
        """Name what was changed, if anything was."""
        for name, value in self.live.items():
            if not _same(self.copies[name], _copy(value)):
                raise ProgramError(
                    Fault.STATE,
                    site,
                    f"the program changes {name}, and {what if site is None else f'site {site!r}'} depends "
                    "on it; compute it in each run, and pass it on as a value.",
                )


class _Global:
    def __init__(self, names: Mapping[str, Any], name: str) -> None:
        self.names, self.name = names, name

    def now(self) -> Any:
        return self.names.get(self.name)


class _Cell:
    def __init__(self, cell: Any) -> None:
        self.cell = cell

    def now(self) -> Any:
        try:
            return self.cell.cell_contents
        except ValueError:
            return None


def _copy(value: Any, depth: int = 4) -> Any:
    """A copy of numbers, arrays, containers and the attributes of plain objects; else the object itself."""
    if isinstance(value, _Global | _Cell):
        return _copy(value.now())
    if isinstance(value, Tensor):
        return value.detach().clone()
    if isinstance(value, np.ndarray):
        return value.copy()
    if depth == 0:
        return value
    if isinstance(value, list | tuple | set | frozenset):
        return [_copy(each, depth - 1) for each in value]
    if isinstance(value, Mapping):
        return [(key, _copy(each, depth - 1)) for key, each in value.items()]
    held = getattr(value, "__dict__", None)
    if (
        isinstance(held, dict)
        and not isinstance(value, type | FunctionType)
        and type(value).__module__ != "builtins"
    ):
        return [(key, _copy(each, depth - 1)) for key, each in held.items()]
    return value


def _same(first: Any, second: Any) -> bool:
    if isinstance(first, Tensor | np.ndarray):
        return type(first) is type(second) and equal(first, second)
    if isinstance(first, list | tuple):
        return type(first) is type(second) and len(first) == len(second) and all(map(_same, first, second))
    try:
        return first is second or bool(first == second)
    except (RuntimeError, ValueError):
        return False
