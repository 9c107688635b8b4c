"""Doubts: what is probably wrong with a recording, by geometry, before anything is inferred.

    for doubt in doubts(recording):
        print(doubt)

A quaternion in another order, a camera of OpenGL, a flange's pose in place of the peg's: such a recording is
well formed, so no check of its numbers sees it. But what was seen and felt does not fit the part within the
guess, and it does under the mistake's repair. All repairs are tried; the one that explains most is named.
It lies with the sensors, for it asks which kind a measurement is.
"""

from __future__ import annotations

from bcppl.sensors import checks
from bcppl.sensors.measurements import Recording
from bcppl.sensors.plausibility.touches import touch_doubts
from bcppl.sensors.plausibility.views import view_doubts

__all__ = ["doubts"]


def doubts(recording: Recording) -> list[str]:
    """What is probably wrong with a recording, with its cause and cure, one sentence each.

    Views and probes are compared with the part within the guess; measurements that cannot be read, and kinds
    other than these, are left out.
    """
    part, guess = recording.part, recording.guess
    if list(checks.part(part, closed=False)) or list(checks.pose("", guess.world_from_part)):
        return []
    lines, start = view_doubts(recording.measurements, part, guess)
    return lines + touch_doubts(recording.measurements, part, recording.peg, guess, start)
