"""Parameters of distributions: each is declared, and refused out of its range in one sentence."""

from __future__ import annotations

import inspect
import math
import pkgutil
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch

import bcppl.distributions
from bcppl import poses
from bcppl.distributions.contact import ChamferContacts, ContactsInTime, PegPose, Wrench
from bcppl.distributions.depth import ClutteredDepth, LaplaceDepth, RobustDepth
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.manifold import ContactManifold
from bcppl.distributions.parameters import Range, ranges
from bcppl.distributions.silhouette import Silhouette
from bcppl.distributions.touch import ForceDirection, FreePath, OnsetLocation, Path
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera

POSE = poses.identity(2)
CAMERA = Camera("c", 4, 3, 8.0, 8.0, 1.5, 1.0, np.array([0, 0, -0.4, 1.0, 0, 0, 0]))
IMAGE: dict[str, Any] = {"camera": CAMERA, "pose": POSE, "scale": 0.003}
STAMPS: dict[str, Any] = {"first": 0, "last": 1}
PATH = Path(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64))


class Renderer:
    def hits(self, *given: Any) -> Any:
        raise AssertionError("a distribution is built without rendering")


class Track:
    inputs = (POSE,)

    def __len__(self) -> int:
        return 2


def depth(kind: type) -> Callable[..., Any]:
    return lambda **given: kind(Renderer(), **{**IMAGE, **given})


MAKE: dict[type, Callable[..., Any]] = {
    ChamferContacts: lambda **given: ChamferContacts(
        Track(), **{**STAMPS, "scale": 1.0, "one_empty": 1.0, **given}
    ),
    ContactsInTime: lambda **given: ContactsInTime(Track(), **{**STAMPS, "scale": 1.0, **given}),
    PegPose: lambda **given: PegPose(
        Track(), **{**STAMPS, "translation_scale": 1.0, "rotation_scale": 1.0, **given}
    ),
    Wrench: lambda **given: Wrench(Track(), **{**STAMPS, "force_scale": 1.0, "torque_scale": 1.0, **given}),
    ContactManifold: lambda **given: ContactManifold(
        None, POSE, **{"stamps": 3, "noise": 1.0, "shared": 1.0, **given}
    ),
    LaplaceDepth: depth(LaplaceDepth),
    RobustDepth: depth(RobustDepth),
    ClutteredDepth: depth(ClutteredDepth),
    Silhouette: lambda **given: Silhouette(Renderer(), CAMERA, POSE, **{"width": 1.0, **given}),
    OnsetLocation: lambda **given: OnsetLocation(
        None, POSE, PATH, **{"offset": 0.0, "spread": 1.0, "outlier": 0.1, **given}
    ),
    ForceDirection: lambda **given: ForceDirection(
        None,
        POSE,
        PATH.points[0],
        PATH.points[1],
        **{"friction": 0.4, "spread": 0.1, "outlier": 0.1, **given},
    ),
    FreePath: lambda **given: FreePath(
        None, POSE, PATH, PATH.points[0], **{"tolerance": 0.0, "spread": 0.1, **given}
    ),
}


def outside(allowed: Range) -> Iterator[Any]:
    """Values just out of a range, and values that are no numbers."""
    yield from (math.nan, math.inf, "a")
    if allowed.whole:
        yield from (allowed.least - 1, 2.5, 3.0)
    bounds = {allowed.above: 0.0, allowed.least: -1e-6, allowed.below: 0.0, allowed.most: 1e-6}
    yield from (bound + beyond for bound, beyond in bounds.items() if math.isfinite(bound))


@pytest.mark.parametrize("kind", MAKE, ids=lambda kind: kind.__name__)
def test_a_parameter_out_of_its_range_is_refused(kind: Any) -> None:
    MAKE[kind]()
    for name, allowed in ranges(kind).items():
        for value in outside(allowed):
            said = rf"^{kind.__name__} has {name} = .*; give a (finite|whole) number[^\n]*\.$"
            with pytest.raises(InputError, match=said):
                MAKE[kind](**{name: value})
        if allowed.optional:
            assert getattr(MAKE[kind](**{name: None}), name) is None
        if allowed.latent:
            assert len(getattr(MAKE[kind](**{name: torch.tensor([-1.0, 1.0])}), name)) == 2


def test_every_number_that_a_distribution_takes_is_declared() -> None:
    for module in pkgutil.walk_packages(bcppl.distributions.__path__, "bcppl.distributions."):
        import_module(module.name)
    kinds = set(LazyDistribution.__subclasses__())
    while new := {each for kind in kinds for each in kind.__subclasses__()} - kinds:
        kinds |= new
    shipped = {kind for kind in kinds if kind.__module__.startswith("bcppl.distributions.")}
    assert {kind for kind in MAKE if issubclass(kind, LazyDistribution)} <= shipped
    for kind in shipped:
        given = inspect.signature(kind.__init__).parameters.values()
        plain = [each for each in given if each.kind is not each.VAR_KEYWORD]
        annotations = {each.name: str(each.annotation).removesuffix(" | None") for each in plain}
        numbers = {name for name, annotation in annotations.items() if annotation in ("float", "int")}
        assert numbers <= {*ranges(kind), "particles", "entries", "cost"}, kind


def test_a_parameter_is_kept_as_a_float_or_an_int() -> None:
    wrench = MAKE[Wrench](force_scale=torch.tensor(2.0), every=np.int64(3))
    assert (wrench.force_scale, wrench.every) == (2.0, 3)
    assert type(wrench.force_scale) is float and type(wrench.every) is int
