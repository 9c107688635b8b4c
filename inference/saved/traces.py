"""Traces as plain data, and traces made again of those by running their program at the same values.

What a run computes from values and arguments is computed again. What it cannot give again to the bit is
kept: log-probabilities, which were evaluated in batches of other particles, the numbers of carried simulator
states, and of a series without history the state before its newest step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.support import support_of
from bcppl.errors import InferenceError, InputError
from bcppl.inference.saved.plain import NotPlainError, plain, same
from bcppl.traces import Series, Trace
from bcppl.traces.carried import Branching, Storable
from bcppl.traces.run import Program, Run, run
from bcppl.traces.series import Forgotten, SeriesTrace, Stage

Content = dict[str, Any]
# The arguments of the program; of a series those of a step, by its number.
Arguments = Callable[[int], tuple[Any, ...] | None]

TOLERANCE = 1e-6  # of log-probabilities that a program gives again, on another machine perhaps


def content_of(trace: Trace) -> Content:
    """The plain data of a trace.

    Raises:
        InputError: it is no trace, its likelihood is estimated by filters (`marginal`), or a series without
            history has a state that is no plain data.
    """
    if type(trace) not in (Trace, SeriesTrace):
        raise InputError(f"a {type(trace).__name__} cannot be saved; save a trace, or a population of one.")
    content: Content = {"program": name_of(trace.program), "particles": trace.particles, "origin": None}
    if isinstance(trace, SeriesTrace):
        nodes, whole = [], trace if trace.origin is None else trace.origin[0]
        node: SeriesTrace | None = whole
        while node is not None and not isinstance(node, Forgotten):
            nodes.append(node)
            node = node.stage.before
        content["before"] = None if node is None else _state(node)
        nodes.reverse()
        content["steps"] = [_values(n, carries=n is trace) | {"chosen": n.stage.chosen} for n in nodes]
        if trace.origin is not None:
            content |= {"origin": trace.origin[1], "newest": _values(trace) | {"choices": {}}}
    else:
        content["steps"] = [_values(trace)]
    checked = torch.unique(torch.tensor([0, trace.particles // 2, trace.particles - 1]))
    return content | {"checked": checked, "log_prob": _evaluated(trace, checked)}


def _values(trace: Trace, carries: bool = True) -> Content:
    content: Content = {
        "particles": trace.particles,
        "choices": dict(trace.choices),
        "observations": dict(trace.observations),
        "known": dict(trace.known),
        "hidden": sorted(trace.hidden),
        "args": None,
        "kinds": ", ".join(type(arg).__name__ for arg in trace.args),
        "carried": {},
    }
    # A past step of a series is moved no more, and its simulators are not asked again.
    if carries:
        _ = trace._run  # makes the carried states those of the present values
        states = {name: entry.state for name, entry in trace.carried.items() if name in trace._run.carried}
        if own := next((name for name, state in states.items() if isinstance(state, Branching)), None):
            raise InputError(
                f"a trace whose likelihood is estimated at random, by the {own}, cannot be saved, for its "
                "program would estimate another one; save the values and the weights (`torch.save`)."
            )
        content["carried"] = {n: dict(s.stored()) for n, s in states.items() if isinstance(s, Storable)}
    with suppress(NotPlainError):
        content["args"] = plain(tuple(trace.args))
    return content


def _state(forgotten: SeriesTrace) -> Content:
    try:
        return {"particles": forgotten.particles, "steps": forgotten.steps, "state": plain(forgotten.state)}
    except NotPlainError as error:
        raise InputError(
            f"a series without history has a state with a {error}, which cannot be saved; "
            "return tensors, or make the series with `history=True`."
        ) from error


def name_of(program: Program | Series) -> str:
    """The name of a program, for messages."""
    program = program.series if isinstance(program, Stage) else program
    inner: Any = program.step if isinstance(program, Series) else program
    inner = getattr(inner, "func", inner)
    return str(getattr(inner, "__name__", type(inner).__name__))


def _evaluated(trace: Trace, particles: Tensor) -> dict[str, Tensor]:
    """The log-probability (K,) of every site of a few particles, evaluated from nothing but their values."""
    few = replace(trace.chosen(particles).settled(), carried={}, known={})
    return {address: few.log_prob(address) for address in few.addresses}


def trace_of(content: Content, program: Program | Series, given: Arguments) -> Trace:
    """The trace that `content_of` was given.

    Raises:
        InputError: the program or its arguments are others than those that the content is of; names the site.
    """
    series = "before" in content
    if isinstance(program, Series) != series:
        kinds = ("a series", "one program") if series else ("one program", "a series")
        raise InputError(f"the file is of {kinds[0]}, but the program given is {kinds[1]}; give its own.")
    first = content["before"]["steps"] + 1 if series and content["before"] is not None else 0
    args = [_arguments(values, given(k)) for k, values in enumerate(content["steps"], start=first)]
    own, of = repr(name_of(program)), f"the file is of {content['program']!r}"
    try:
        if isinstance(program, Series):
            trace: Trace = _series(content, program, args, first)
        else:
            trace, _ = _ran(Trace, program, content["steps"][0], args[0])
        again = _evaluated(trace, content["checked"])
    except InputError as error:
        raise InputError(f"{of}, and {own} cannot be run at its values: {error}") from error
    except (RuntimeError, TypeError, ValueError, LookupError, AttributeError, InferenceError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(".")
        raise InputError(f"{of}, and {own} cannot be run at its values ({reason}); give its own.") from error
    for address, expected in content["log_prob"].items():
        if not torch.allclose(again[address], expected, rtol=TOLERANCE, atol=TOLERANCE):
            which = int((again[address] - expected).nan_to_num().abs().argmax())
            raise InputError(
                f"{of}, and {own} gives site {address!r} log-probability {float(again[address][which]):.6g} "
                f"where that gave {float(expected[which]):.6g}; give the program and the arguments that it "
                "was saved with."
            )
    return trace


def _arguments(values: Content, given: tuple[Any, ...] | None) -> tuple[Any, ...]:
    kept = values["args"]
    if given is None:
        if kept is None:
            raise InputError(f"its arguments ({values['kinds']}) cannot be saved; give them as `args`.")
        return tuple(kept)
    try:
        if kept is not None and not same(plain(tuple(given)), kept):
            raise InputError(f"it was saved with the arguments {kept!r}; leave out `args`, or give those.")
    except NotPlainError as error:
        raise InputError(f"it was saved with the arguments {kept!r}, not with a {error}.") from error
    return tuple(given)


def _series(content: Content, series: Series, args: Sequence[tuple[Any, ...]], first: int) -> SeriesTrace:
    before: SeriesTrace | None = None
    if first:
        held = content["before"]
        before = Forgotten(Stage(series, held["steps"]), (), held["particles"], {}, {})
        before.__dict__["_result"] = held["state"]
    if first + len(args) > 1 and series.history == bool(first):
        raise InputError(f"it was made with `history={not series.history}`; give it so.")
    for number, (values, each) in enumerate(zip(content["steps"], args, strict=True), start=first):
        picks = () if values["chosen"] is None else (values["chosen"],)
        before, ran = _ran(SeriesTrace, Stage(series, number, before, picks), values, each)
        # As `SeriesTrace.next_stage` leaves a past step.
        before.__dict__["_result"] = ran.result
    assert before is not None
    trace = before
    del trace.__dict__["_result"]
    if content["origin"] is None:
        return trace
    newest = trace.chosen(content["origin"])
    values = content["newest"]
    newest = replace(newest, carried={}, known=values["known"], hidden=frozenset(values["hidden"]))
    return _with_carried(newest, newest._run, values)[0]


def _ran(kind: type[Any], program: Program, values: Content, args: tuple[Any, ...]) -> tuple[Any, Run]:
    """A trace of the program run at stored values; what it would sample is missing in the file."""
    choices, observations = values["choices"], values["observations"]
    trace = kind(
        program,
        args,
        values["particles"],
        choices,
        observations,
        known=values["known"],
        hidden=frozenset(values["hidden"]),
    )
    ran = run(program, args, trace.particles, {**choices, **observations}, {}, draws_lazy=False)
    ran.refuse_unvisited([*choices, *observations])
    for address, site in ran.distributions.items():
        if address not in trace and address not in ran.fixed:
            raise InputError(f"it holds no value at address {address!r}, which the program visits.")
        if address in choices:
            _refuse_unfit(address, choices[address], site, trace.particles)
    for address, known in values["known"].items():
        if known.shape != (trace.particles,) or known.dtype != torch.float64:
            raise InputError(f"it holds no log-probabilities at address {address!r}.")
    return _with_carried(trace, ran, values)


def _with_carried(trace: Trace, ran: Run, values: Content) -> tuple[Any, Run]:
    trace.carried.update(ran.carried)
    stored: Mapping[str, Mapping[str, Any]] = values["carried"]
    for name, arrays in stored.items():
        if name not in ran.carried or not isinstance(ran.carried[name].state, Storable):
            raise InputError(f"it holds a simulator's state {name!r}, which the program does not have.")
        entry = ran.carried[name]
        trace.carried[name] = replace(entry, state=entry.state.restored(arrays))
    # The run is not kept: its distributions hold states before the first step.
    trace.__dict__.pop("_run", None)
    return trace, ran


def _refuse_unfit(address: str, value: Tensor, site: Any, particles: int) -> None:
    shape = (particles, *site.batch_shape[:-1], *site.event_shape)
    if tuple(value.shape) != shape:
        raise InputError(f"its value at {address!r} has shape {tuple(value.shape)}, the program's {shape}.")
    if not value.is_floating_point() and not support_of(site).is_discrete:
        raise InputError(f"its value at {address!r} is of {value.dtype}, the program's is real.")
