"""From what may be done next to a model's action."""

from __future__ import annotations

from bcppl.robot.motion import ProbeWindow
from bcppl.robot.plan import Plan, probe_of
from bcppl.sensors.measurements import View


def action_of(candidate: Plan | View) -> ProbeWindow | View:
    """What a model takes as an action: a plan as one window of which nothing is stopped, a view as it is."""
    if isinstance(candidate, View):
        return candidate
    probe = probe_of(candidate)
    return ProbeWindow(probe, 0, len(probe.stamps))
