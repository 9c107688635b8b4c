"""TEMPORARY (replaced on merge)."""

from typing import Any

from bcppl.errors import InputError
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.measurements import Push, View

_K = {View: "view", ProbeWindow: "window", Push: "push"}


def kind_of(action: Any) -> str:
    if type(action) not in _K:
        raise InputError(f"an action is a {type(action).__name__}, of no known kind of measurement.")
    return _K[type(action)]


def sensor_named(kind: str) -> Any:
    return None
