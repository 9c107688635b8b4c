"""Programs and proposals name an action that they do not know, and treat none as another."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from typing import Any

import pytest

from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.proposals.approximated import backward_kernel, forward_kernel
from bcppl.models import look_and_touch, peg_in_hole
from bcppl.recordings import Probe, ProbeWindow, Push, Recording, View, load
from bcppl.traces import Model, generate, simulate

PARTICLES = 3


@functools.cache
def shipped(name: str) -> Recording:
    with as_file(files("bcppl.models") / f"recordings/{name}.h5") as file:
        return load(file)


@dataclass(frozen=True, eq=False)
class Squeeze:
    """Another action that has all that a window has."""

    probe: Probe
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Glance:
    """Another action that has all that a view has."""

    camera: Camera


class Sniff:
    """Another that has nothing."""


def window() -> ProbeWindow:
    return next(m.action for m in shipped("peg_probe").measurements if isinstance(m.action, ProbeWindow))


def view() -> View:
    return next(m.action for m in shipped("peg_probe").measurements if isinstance(m.action, View))


OTHERS: dict[str, Callable[[], Any]] = {
    "Push": lambda: next(m.action for m in shipped("point_probe_10_pushes").measurements),
    "Squeeze": lambda: Squeeze(window().probe, 0, 10),
    "Glance": lambda: Glance(view().camera),
    "Sniff": Sniff,
}
MODELS = {"look_and_touch": look_and_touch.model, "peg_in_hole": peg_in_hole.model}


@functools.cache
def scene(name: str, held: bool) -> Any:
    """Of two views and two windows, or of the views alone, where nothing was held."""
    whole = shipped("peg_probe")
    count, peg = (4, whole.peg) if held else (2, None)
    return MODELS[name].prepare(replace(whole, measurements=whole.measurements[:count], peg=peg))


@pytest.mark.parametrize("held", [True, False], ids=["with a peg", "without"])
@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("name", MODELS)
def test_a_program_names_an_action_that_it_does_not_know(name: str, kind: str, held: bool) -> None:
    model: Model = MODELS[name]
    program: Any = model.program
    for before in ([], [view()]):
        with pytest.raises(InputError, match=f"(?i){kind}"):
            simulate(program, (scene(name, held), [*before, OTHERS[kind]()]), PARTICLES)


@pytest.mark.long
@pytest.mark.parametrize("kind", OTHERS)
def test_an_approximation_and_its_kernels_name_an_action_that_they_do_not_know(kind: str) -> None:
    """After a view, an action of another kind is treated as neither a view nor a window."""
    model, known, action = look_and_touch.model, scene("look_and_touch", True), OTHERS[kind]()
    observed = known.observed(shipped("peg_probe").measurements[:1])
    trace, _ = generate(model.program, (known, [view()]), observed, PARTICLES)
    given = GaussianApproximation(model.pose, known).including(known, 0, view(), observed)
    with pytest.raises(InputError, match=f"(?i){kind}"):
        given.including(known, 1, action, observed)
    for kernel in (forward_kernel, backward_kernel):
        with pytest.raises(InputError, match=f"(?i){kind}"):
            simulate(kernel(given, given, action), (trace,), PARTICLES)


def test_a_push_is_a_push() -> None:
    """The push of the other tests is one, and known actions are still run."""
    assert isinstance(OTHERS["Push"](), Push)
    for name, model in MODELS.items():
        trace = simulate(model.program, (scene(name, True), [view()]), PARTICLES)
        assert trace.particles == PARTICLES
