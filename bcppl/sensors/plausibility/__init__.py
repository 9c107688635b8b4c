"""Doubts: what is probably wrong with a recording, by geometry, before anything is inferred.

    for doubt in doubts(recording):
        print(doubt)

A quaternion in another order, a camera of OpenGL, a flange's pose in place of the peg's: such a recording is
well formed, so no check of its numbers sees it. But what was seen and felt does not fit the part within the
guess, and it does under the mistake's repair. All repairs are tried; the one that explains most is named.
It lies with the sensors, for it asks which kind a measurement is.
"""

from __future__ import annotations

from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import checks
from bcppl.sensors.depth import View
from bcppl.sensors.measurements import Recording

__all__ = ["doubts"]


def doubts(recording: Recording) -> list[str]:
    """What is probably wrong with a recording, with its cause and cure, one sentence each.

    Views and probes are compared with the part within the guess; measurements that cannot be read, and kinds
    other than these, are left out.
    """
    part, guess, measurements = recording.part, recording.guess, recording.measurements
    if not any(isinstance(each.action, View | ProbeWindow) for each in measurements):
        return []
    if list(checks.part(part, closed=False)) or list(checks.pose("", guess.world_from_part)):
        return []
    # These import torch and the renderer, which take seconds.
    from bcppl.sensors.plausibility.touches import touch_doubts
    from bcppl.sensors.plausibility.views import view_doubts

    lines, start = view_doubts(measurements, part, guess)
    return lines + touch_doubts(measurements, part, recording.peg, guess, start)
