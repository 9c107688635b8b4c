"""A scene: the prior of a part's pose, and a likelihood for each kind of measurement of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import pyro
import torch
from torch import Tensor

from bcppl.devices import to_device
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.simplified import simplified
from bcppl.sensors.capabilities import Approximated
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import HasLikelihood, sensor_named, sensor_of


class Numbered(NamedTuple):
    """A measurement and its number in the recording, from 0; addresses end with it."""

    number: int
    measurement: Measurement


def by_probe(measurements: Sequence[Numbered]) -> list[list[Numbered]]:
    """Windows, those of each probe together in their order."""
    probes: dict[str, list[Numbered]] = {}
    for each in measurements:
        probes.setdefault(each.measurement.action.probe.name, []).append(each)
    return list(probes.values())


class Likelihood(Protocol):
    """The likelihood of one kind of measurement, prepared from one recording.

    Capabilities that a filter or a ranking asks for by protocol are in `bcppl.sensors.capabilities`.
    """

    def observe(self, number: int, action: Any, world_from_part: Tensor) -> None:
        """Sample the sites of one measurement, and its nuisance parameters with the first that needs them.

        Args:
            number: of the measurement in the recording; addresses end with it.
            action: what the robot did.
            world_from_part: (N, 7).
        """

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The observed values of these measurements, by address."""

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cumulative cost of each simulator, by name."""


@dataclass(frozen=True, eq=False)
class OneSite:
    """The likelihood of measurements with one site each.

    Attributes:
        name: of the sites; addresses are name_0, name_1, ...
        site: the distribution at poses (N, 7) of the part, given the action and metres that are added to its
            standard deviation in quadrature.
        value: the observed value of an observation.
    """

    name: str
    site: Callable[[Tensor, Any, float], Any]
    value: Callable[[Any], Tensor]

    def address(self, number: int) -> str:
        """The address of a measurement."""
        return f"{self.name}_{number}"

    def observe(self, number: int, action: Any, world_from_part: Tensor) -> None:
        """Sample the site of one measurement."""
        pyro.sample(self.address(number), self.site(world_from_part, action, 0.0))

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The observed values of these measurements, by address."""
        return {self.address(n): self.value(m.observation) for n, m in measurements}

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of simulators: it is not counted."""
        return {}


class LinearisedSite(OneSite):
    """The same of a distribution with a `quadratic`, by which filters approximate it (`Linearised`)."""

    def sites(
        self, measurements: Sequence[Approximated], part: Tensor, blur: float
    ) -> Iterator[tuple[Any, Tensor]]:
        """Each measurement's likelihood at poses (S, 7), its noise `blur` wider, and its value."""
        yield from ((self.site(part, action, blur), value) for _, action, value in measurements)


Prepare = Callable[[Recording], Likelihood | None]


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run.

    Attributes:
        prior: of the part's pose.
        likelihoods: by kind of measurement.
        model: the model's name, for messages.
    """

    prior: Any
    likelihoods: Mapping[str, Likelihood]
    model: str

    def sensor(self, action: Any) -> Any:
        """The likelihood of measurements that were made by an action of this kind.

        Raises:
            InputError: the model does not explain this kind of measurement.
        """
        kind = sensor_of(action).kind
        if kind not in self.likelihoods:
            raise InputError(
                f"{self.model} does not explain a measurement of kind {kind!r}; choose another model "
                f"(it explains {', '.join(self.likelihoods) or 'none here'})."
            )
        return self.likelihoods[kind]

    def observed(self, measurements: Sequence[Measurement]) -> dict[str, Tensor]:
        """The observed values of a recording's first measurements, by address.

        Raises:
            InputError: the model does not explain a measurement.
        """
        by_kind: dict[str, list[Numbered]] = {}
        for number, measurement in enumerate(measurements):
            self.sensor(measurement.action)
            by_kind.setdefault(sensor_of(measurement.action).kind, []).append(Numbered(number, measurement))
        return {
            address: value
            for kind, numbered in by_kind.items()
            for address, value in self.likelihoods[kind].observed(numbered).items()
        }

    def on(self, device: torch.device) -> Self:
        """The same scene with its prior on a device; likelihoods work where the poses are that they get."""
        prior = to_device(self.prior, device)
        return self if prior is self.prior else replace(self, prior=prior)

    def likelihoods_of(self, actions: Sequence[Any]) -> list[Likelihood]:
        """The likelihoods of all kinds that some actions are of."""
        return list({id(each): each for each in map(self.sensor, actions)}.values())

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cumulative cost of each simulator, by name."""
        return {name: effort for each in self.likelihoods.values() for name, effort in each.efforts.items()}


S = TypeVar("S", bound=Scene)


def likelihoods_for(
    recording: Recording, chosen: Mapping[str, Prepare], only: bool = False
) -> dict[str, Likelihood]:
    """A likelihood for each kind of measurement, of part and peg `simplified`.

    Args:
        recording: what was measured.
        chosen: by kind, how this model prepares its likelihood; None from it where the recording lacks what
            the kind needs.
        only: leave out the kinds that are not chosen; otherwise those in the recording get the default of
            their sensor.
    """
    peg = None if recording.peg is None else simplified(recording.peg)
    recording = replace(recording, part=simplified(recording.part), peg=peg)
    prepared = {kind: prepare(recording) for kind, prepare in chosen.items()}
    if not only:
        for kind in dict.fromkeys(sensor_of(m.action).kind for m in recording.measurements):
            sensor = sensor_named(kind)
            if kind not in prepared and isinstance(sensor, HasLikelihood):
                prepared[kind] = sensor.prepare(recording)
    return {kind: each for kind, each in prepared.items() if each is not None}


_KINDS = (str, bool, Sequence, Mapping)  # what is one of these is no number, and the other way round


def _with_fields(what: str, default: Any, value: Mapping[str, Any]) -> Any:
    """A default with some fields of its own, as the command line gives them."""
    known = [field.name for field in fields(default)]
    if not value or (unknown := [name for name in value if name not in known]):
        wrong = f"has no field {unknown[0]!r}" if value else "is given no field"
        raise InputError(f"{what} {wrong}; it has {', '.join(known)}.")
    return replace(default, **value)


def chosen(model: str, given: Mapping[str, Any], *defaults: Any) -> list[Any]:
    """The default settings, each with those of the given values that are its fields.

    Args:
        model: its name, for messages.
        given: values by name; of one that is a dataclass also a mapping of some of its fields.
        defaults: dataclasses.

    Raises:
        InputError: no default has a field of a given name, or a value is of another kind or out of range.
    """
    names = [{field.name for field in fields(each)} for each in defaults]
    unknown = sorted(set(given).difference(*names))
    if unknown:
        known = ", ".join(sorted(set().union(*names)))
        raise InputError(f"{model} has no setting {unknown[0]!r}; its settings are {known}.")
    for each, own in zip(defaults, names, strict=True):
        for name in own.intersection(given):
            value, default = given[name], getattr(each, name)
            if is_dataclass(default) and isinstance(value, Mapping):
                given = {**given, name: _with_fields(f"setting {name!r} of {model}", default, value)}
                continue
            kinds = (*_KINDS, type(default)) if is_dataclass(default) else _KINDS
            if default is not None and any(isinstance(value, k) != isinstance(default, k) for k in kinds):
                raise InputError(
                    f"setting {name!r} of {model} is given {value!r}; give a value such as its default, "
                    f"{default!r}."
                )
    return [
        replace(each, **{name: value for name, value in given.items() if name in own})
        for each, own in zip(defaults, names, strict=True)
    ]
