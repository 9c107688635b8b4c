"""Populations in files: saved in one process, gone on with in another, equal to the bit."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.population import Population, refuse_no_population
from bcppl.inference.saved import plain
from bcppl.inference.saved.approximations import approximation_content, approximation_of
from bcppl.inference.saved.traces import Arguments, Content, content_of, trace_of
from bcppl.recordings.beliefs import FORMAT as BELIEF
from bcppl.recordings.hdf5 import created, opened as opened_file
from bcppl.traces import Series
from bcppl.traces.run import Program

FORMAT = "bcppl population"
SCHEMA_VERSION = 1
COMPUTED = ("log_total", "effective_sample_size")  # cached, by sums of another order than their own

Location = str | os.PathLike[str]


def save(population: Population | Sequence[Population], path: Location) -> None:
    """Write a population, or several, and the state of torch's generator to one HDF5 file, all or nothing.

    The file holds numbers: the program is not in it, nor are arguments that are no plain data (numbers, text,
    tensors, arrays, and tuples, lists and dictionaries of those), such as a scene. To compare with the
    program that is given to `load`, the sites' log-probabilities are evaluated once more for three
    particles.

    Args:
        population: of a program or a series, with its simulators' states and the filter's approximation.
        path: where to.

    Raises:
        InputError: what is given is no population (of strata see `bcppl.inference.structures.save_strata`),
            there is no such folder, or something is no plain data: the state of a series without
            history, a field that a subclass adds, an approximation of another kind.
    """
    several: list[Any] = list(population) if isinstance(population, list | tuple) else [population]
    if hasattr(population, "populations"):
        raise InputError("save is given strata; save them by `save_strata` of bcppl.inference.structures.")
    for each in several:
        refuse_no_population("save", each)
    content = {"populations": [population_content(each) for each in several]}
    write(path, content, torch.get_rng_state())


def load(path: Location, program: Program | Series, args: Any = None) -> Population:
    """The population in a file that `save` wrote. Torch's generator is left as it is: see `random_state`.

    Args:
        path: of the file.
        program: that the population is of.
        args: a tuple, the program's arguments; needed where they are no plain data. Of a series those of the
            newest step, or a list of tuples, of every step that the file has, that of `init` first.

    Raises:
        InputError: there is no such file, it is damaged or of another version, it holds several populations,
            or it is of another program or other arguments: then it names a site.
    """
    populations = load_several(path, program, args)
    if len(populations) != 1:
        raise InputError(f"{path} holds {len(populations)} populations; use `load_several`.")
    return populations[0]


def load_several(path: Location, program: Program | Series, args: Any = None) -> list[Population]:
    """The populations of one program in a file that `save` wrote, in order; it raises what `load` does."""
    with opened(path) as content:
        return [population_of(each, program, given_arguments(args, each)) for each in content["populations"]]


def random_state(path: Location) -> Tensor:
    """The state of torch's generator when a file was saved, for `torch.set_rng_state`.

    Raises:
        InputError: there is no such file, or it is damaged or of another version.
    """
    with opened(path) as content:
        state: Tensor = content["random_state"]
        return state


def population_content(population: Population) -> Content:
    """The plain data of a population: of its trace, its other fields, and what sums it has cached.

    Raises:
        InputError: something is no plain data.
    """
    own = {f.name: getattr(population, f.name) for f in fields(population)}
    trace, approximation = own.pop("trace"), own.pop("approximation")
    computed = {n: population.__dict__[n] for n in COMPUTED if n in population.__dict__}
    try:
        held = plain.plain(own)
    except plain.NotPlainError as error:
        raise InputError(f"a population with a field of type {error} cannot be saved.") from error
    return {
        "trace": content_of(trace),
        "fields": held,
        "computed": computed,
        "approximation": approximation_content(approximation),
    }


def population_of(content: Content, program: Program | Series, given: Arguments) -> Population:
    """The population that `population_content` was given.

    Raises:
        InputError: the program or its arguments are others, or a field is of other particles or unknown.
    """
    with torch.random.fork_rng(devices=[]):
        trace = trace_of(content["trace"], program, given)
        approximation = approximation_of(content["approximation"], trace)
    own = content["fields"]
    for name, value in own.items():
        if isinstance(value, Tensor) and len(value) not in (0, trace.particles):
            raise InputError(f"its {name} are of {len(value)} particles, the trace of {trace.particles}.")
    unknown = own.keys() - {f.name for f in fields(Population)}
    if unknown:
        raise InputError(f"it has a field {min(unknown)!r}, which this bcppl does not know; upgrade bcppl.")
    population = Population(trace, approximation=approximation, **own)
    population.__dict__.update({n: float(value) for n, value in content["computed"].items() if n in COMPUTED})
    return population


def given_arguments(args: Any, content: Content) -> Arguments:
    """The arguments of each step; one tuple is of the newest, whose number is the last.

    Raises:
        InputError: they are no tuple, nor one for each step of a series.
    """
    if args is None:
        return lambda number: None
    if not isinstance(args, tuple | list):
        raise InputError(
            f"a program's arguments are of type {type(args).__name__}; give a tuple of them, `(x,)` for one."
        )
    trace = content["trace"]
    last = len(trace["steps"]) - 1
    if trace.get("before") is not None:
        last += trace["before"]["steps"] + 1
    if isinstance(args, tuple):
        return lambda number: args if number == last else None
    if len(args) != len(trace["steps"]) or not all(isinstance(each, tuple) for each in args):
        raise InputError(
            f"arguments of {len(args)} steps are given, but the file has {len(trace['steps'])} steps; "
            "give a tuple for each."
        )
    return lambda number: args[number - last - 1]


def write(path: Location, content: Content, state: Tensor) -> None:
    """Write content with torch's random state and a hash, all or nothing."""
    with created(path) as file:
        file.attrs.update(format=FORMAT, schema_version=SCHEMA_VERSION, written_by=_version())
        plain.write(file, {**content, "random_state": state})


def _version() -> str:
    try:
        return f"bcppl {version('bcppl')}"
    except PackageNotFoundError:
        return "bcppl"


@contextmanager
def opened(path: Location) -> Iterator[Content]:
    """The content of a file, checked; what goes wrong with it names the file.

    Raises:
        InputError: there is no such file, or it is damaged or of another version.
    """
    if not isinstance(path, str | os.PathLike) or not (path := Path(path)).is_file():
        raise InputError(f"there is no file {path}; give one that `save` wrote.")
    with opened_file(path, "save it again") as file:
        if file.attrs.get("format") != FORMAT:
            held = "a belief and no population" if file.attrs.get("format") == BELIEF else "no population"
            raise InputError(f"it holds {held}; give a file that `save` or `save_step` wrote.")
        number = operator.index(file.attrs["schema_version"])
        if not 1 <= number <= SCHEMA_VERSION:
            raise InputError(
                f"it has schema version {number}, this bcppl reads {SCHEMA_VERSION}; upgrade bcppl."
            )
        content = plain.read(file)
    try:
        yield content
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{path} lacks a part of a population ({error!r}); save it again.") from error
