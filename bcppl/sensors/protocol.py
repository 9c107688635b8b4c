"""The protocol of a kind of measurement, its capabilities, and the registry of kinds.

A sensor is an object that states how its actions and observations lie in files, checks them and describes
them. Further capabilities (candidates, drawings, a default likelihood) are protocols that a sensor may
satisfy, asked for with `isinstance`. A new kind is one module that ends in `register(MySensor())`, imported
in `bcppl.sensors` or named by an entry point of the group "bcppl.sensors".
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.sensors.layout import Layout

if TYPE_CHECKING:
    from bcppl.geometry.parts import Part
    from bcppl.robot.plan import Plan
    from bcppl.sensors.measurements import Measurement, Recording

GROUP = "bcppl.sensors"  # of entry points

# The style of candidates that were not chosen, for matplotlib.
FAINT: dict[str, Any] = {"color": "#c7a6d8", "linewidth": 0.7, "alpha": 0.8, "zorder": 4}

Indexed = Sequence[tuple[int, "Measurement"]]  # with each measurement's place in its recording


class Sensor(Protocol):
    """A kind of measurement.

    Attributes:
        kind: its name in files and labels: "view".
        names: singular and plural, for people.
        contact: whether the part is touched, so that its mesh has to be closed.
        action: the layout of its actions; `action.type` is their type.
        observation: the layout of its observations.
    """

    kind: str
    names: tuple[str, str]
    contact: bool
    action: Layout[Any]
    observation: Layout[Any]

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Everything that is wrong with a recording's measurements of this kind: (index, one sentence)."""

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """Rows (what, value) about a recording's measurements of this kind, which may have problems."""


@runtime_checkable
class HasNotes(Protocol):
    """A sensor that remarks on measurements which may be right but rarely are."""

    def notes(self, measurements: Sequence[Measurement], recording: Recording) -> Iterator[str]:
        """Remarks on a recording's measurements of this kind, one sentence each; they may have problems."""


@runtime_checkable
class Plannable(Protocol):
    """A sensor whose measurements can be planned: a candidate is a measurement that may be made next.

    Attributes:
        candidate: the layout of candidates in files of actions.
        candidate_kind: their kind in files of actions: "plan".
        needs_peg: whether they are made with a held peg.
    """

    candidate: Layout[Any]
    candidate_kind: str
    needs_peg: bool

    def action_of(self, candidate: Any) -> Any:
        """The action that a model takes, if the candidate is carried out as planned."""

    def name_of(self, candidate_or_action: Any) -> str:
        """The name of a candidate, or that under which an action was made."""

    def renamed(self, candidate: Any, name: str) -> Any:
        """The same candidate under another name."""

    def duration(self, candidate: Any) -> float:
        """Seconds that it takes."""


class PlannedAsIs:
    """`Plannable` for actions that have a name and are their own candidates; mixed into a sensor."""

    needs_peg = False

    def action_of(self, candidate: Any) -> Any:
        """The candidate itself."""
        return candidate

    def name_of(self, candidate_or_action: Any) -> str:
        """Its name."""
        return str(candidate_or_action.name)

    def renamed(self, candidate: Any, name: str) -> Any:
        """The same under another name."""
        return replace(candidate, name=name)

    def duration(self, candidate: Any) -> float:
        """No time."""
        return 0.0


@runtime_checkable
class Drawable(Protocol):
    """A sensor whose candidates can be drawn.

    Attributes:
        caption: a line under the title of a drawing of one; "" for none.
    """

    caption: str

    def draw(self, axes: Any, candidate: Any, mean: Array, peg: Part | None, *, faint: bool = False) -> Array:
        """Draw a candidate into axes of `mpl_toolkits.mplot3d`, lengths in millimetres.

        Args:
            axes: lines that belong into the legend carry labels.
            candidate: of this sensor.
            mean: (7,) `world_from_part` of the belief.
            peg: the held peg, if there is one.
            faint: whether it is one of many that were not chosen; no labels then.

        Returns:
            Points (M, 3) in millimetres that the axes have to show.
        """


@runtime_checkable
class AroundPart(Protocol):
    """A sensor that lays candidates out around a part."""

    def around(self, mean: Array, part: Part, like: Any, count: int, seed: int) -> Iterator[Any]:
        """Candidates around a part, `#` in their names where a number belongs.

        Args:
            mean: (7,) `world_from_part`.
            part: at which they aim.
            like: an action of this sensor that they resemble; None for a default.
            count: how many.
            seed: same seed, same candidates.
        """


@runtime_checkable
class Moving(Protocol):
    """A sensor whose candidates are motions of a held peg."""

    def motion(self, candidate: Any) -> Plan:
        """The motion that the arm is commanded to make."""


class Placement(NamedTuple):
    """Where a sensor stands.

    Attributes:
        world_from_sensor: (7,) its z axis is the direction of measurement.
        wrist_from_sensor: (7,) for a sensor on the arm's wrist; None for one that stands by itself.
    """

    world_from_sensor: Array
    wrist_from_sensor: Array | None


@runtime_checkable
class Placed(Protocol):
    """A sensor whose candidates measure from one place."""

    def placement(self, candidate: Any) -> Placement:
        """Where the sensor stands."""


@runtime_checkable
class HasBlank(Protocol):
    """A sensor whose candidates a scene has to know before they are carried out."""

    def blank(self, candidate: Any) -> Any:
        """An observation without content, so that a scene can be prepared for a candidate."""


@runtime_checkable
class InParts(Protocol):
    """A sensor whose measurements come in parts, such as windows of a probe, each after the one before it."""

    def follows(self, measurement: Measurement, before: Sequence[Measurement]) -> bool:
        """Whether all parts before a measurement are among others, which are in their order."""

    def joined(self, first: Measurement, second: Measurement) -> Measurement | None:
        """Two parts as one, the first where the second adds nothing; None where they are apart."""

    def alone(self, measurement: Measurement) -> Measurement:
        """A part as if there were no other, so that it can be checked by itself."""


@runtime_checkable
class HasLikelihood(Protocol):
    """A sensor with a likelihood for models that state none for its kind."""

    def prepare(self, recording: Recording) -> Any:
        """The `bcppl.sensors.scene.Likelihood` of a recording's measurements of this kind."""


_registered: dict[str, Sensor] = {}
_by_type: dict[type, Sensor] = {}
_searched = False


def register(sensor: Sensor) -> None:
    """Make a kind of measurement known; one of the same kind is replaced."""
    _registered[sensor.kind] = sensor
    _by_type[sensor.action.type] = sensor
    if isinstance(sensor, Plannable):
        _by_type[sensor.candidate.type] = sensor


def sensors() -> tuple[Sensor, ...]:
    """All kinds of measurement, in the order of their registration."""
    _search()
    return tuple(_registered.values())


def sensor_named(kind: str) -> Sensor:
    """The sensor of a kind.

    Raises:
        InputError: there is none.
    """
    if (sensor := _looked_up(_registered, kind)) is None:
        raise InputError(
            f"a measurement is of unknown kind {kind[:40]!r}; known are {', '.join(_registered)}: "
            "install the package that registers it."
        )
    return sensor


def sensor_of(thing: Any) -> Sensor:
    """The sensor of an action or of a candidate.

    Raises:
        InputError: there is none.
    """
    if (sensor := _looked_up(_by_type, type(thing))) is None:
        raise InputError(
            f"{type(thing).__name__} is no known kind of action; known are "
            f"{', '.join(known.__name__ for known in _by_type)}: register its sensor."
        )
    return sensor


def sensor_for(measurement: Measurement) -> Sensor:
    """The sensor of a measurement.

    Raises:
        InputError: its action is of no known kind, or its observation is not of that kind's type.
    """
    sensor = sensor_of(measurement.action)
    action, observation = sensor.action.type, sensor.observation.type
    if not (isinstance(measurement.action, action) and isinstance(measurement.observation, observation)):
        given = type(measurement.action).__name__, type(measurement.observation).__name__
        raise InputError(
            f"a {given[0]} is paired with a {given[1]}; a {sensor.names[0]} pairs a {action.__name__} with a "
            f"{observation.__name__}."
        )
    return sensor


def by_sensor(measurements: Sequence[Measurement]) -> list[tuple[Sensor, list[tuple[int, Measurement]]]]:
    """Measurements with their places, by sensor in the order of registration; those of none are left out."""
    indexed: dict[str, list[tuple[int, Measurement]]] = {}
    for index, measurement in enumerate(measurements):
        with suppress(InputError):
            indexed.setdefault(sensor_for(measurement).kind, []).append((index, measurement))
    return [(sensor, indexed[kind]) for kind, sensor in _registered.items() if kind in indexed]


def _looked_up(known: Mapping[Any, Sensor], key: Any) -> Sensor | None:
    if key not in known:
        _search()
    return known.get(key)


def _search() -> None:
    """Load the kinds that installed packages offer, once."""
    global _searched
    if _searched:
        return
    _searched = True
    for offered in entry_points(group=GROUP):
        try:
            offered.load()
        except Exception as error:
            warnings.warn(
                f"the kind of measurement {offered.name!r} ({offered.value}) cannot be loaded: {error}.",
                stacklevel=3,
            )
