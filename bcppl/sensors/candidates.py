"""Candidates: measurements that may be made next, of every kind that can be planned."""

from __future__ import annotations

from typing import Any

from bcppl.errors import InputError
from bcppl.sensors.protocol import Plannable, sensor_of

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


def duration_of(candidate: Candidate) -> float:
    """Seconds that a candidate takes."""
    return planner_of(candidate).duration(candidate)
