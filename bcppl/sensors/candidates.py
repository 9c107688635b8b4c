"""Candidates: measurements that may be made next, of every kind that can be planned."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

from bcppl.errors import InputError
from bcppl.robot.plan import Plan
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import HasBlank, Moving, Placed, Placement, Plannable, sensor_of

Candidate = Any  # of a type that a plannable sensor has registered: a Plan, a View


def planner_of(candidate: Candidate) -> Plannable:
    """The sensor by which a candidate is measured.

    Raises:
        InputError: its kind is not known, or cannot be planned.
    """
    sensor = sensor_of(candidate)
    if not isinstance(sensor, Plannable):
        raise InputError(f"a {sensor.names[0]} cannot be planned; give candidates of another kind.")
    return sensor


def action_of(candidate: Candidate) -> Any:
    """The action that a model takes, if the candidate is carried out as planned.

    A plan becomes one window of which nothing is stopped; a view is its own action.
    """
    return planner_of(candidate).action_of(candidate)


def name_of(candidate_or_action: Any) -> str:
    """The name of a candidate, or that of the probe or camera of an action."""
    return planner_of(candidate_or_action).name_of(candidate_or_action)


def motion_of(candidate: Candidate) -> Plan | None:
    """The motion of the held peg that a candidate is; None for one that is none."""
    sensor = planner_of(candidate)
    return sensor.motion(candidate) if isinstance(sensor, Moving) else None


def placement_of(candidate: Candidate) -> Placement | None:
    """Where the sensor of a candidate stands; None for one that is a motion."""
    sensor = planner_of(candidate)
    return sensor.placement(candidate) if isinstance(sensor, Placed) else None


def with_candidates(recording: Recording, candidates: Sequence[Candidate]) -> Recording:
    """A recording with an observation without content for each candidate that a scene has to know."""
    blanks: dict[tuple[str, str], Measurement] = {}
    known = {(m.kind, _name(m.action)) for m in recording.measurements}
    for each in candidates:
        sensor: Any = planner_of(each)
        key = sensor.kind, sensor.name_of(each)
        if isinstance(sensor, HasBlank) and key not in known:
            blanks.setdefault(key, Measurement(action_of(each), sensor.blank(each)))
    return replace(recording, measurements=[*recording.measurements, *blanks.values()])


def named_apart(candidate: Candidate, recording: Recording, others: Collection[str] = ()) -> Candidate:
    """The candidate under a name that no measurement of its kind in a recording has, nor is among others."""
    sensor: Any = planner_of(candidate)
    taken = {_name(m.action) for m in recording.measurements if m.kind == sensor.kind} | set(others)
    name, number = sensor.name_of(candidate), 2
    free = name
    while free in taken:
        free, number = f"{name} ({number})", number + 1
    return candidate if free == name else sensor.renamed(candidate, free)


def _name(action: Any) -> str:
    sensor = sensor_of(action)
    return sensor.name_of(action) if isinstance(sensor, Plannable) else ""


def duration_of(candidate: Candidate) -> float:
    """Seconds that a candidate takes."""
    return planner_of(candidate).duration(candidate)
