"""Measurements on disk: what a recording holds, its native file, and the importers."""

from bcppl.recordings.measurements import (
    DepthImage,
    Guess,
    Measurement,
    Probe,
    ProbeWindow,
    Push,
    Recording,
    Touch,
    View,
)

__all__ = ["DepthImage", "Guess", "Measurement", "Probe", "ProbeWindow", "Push", "Recording", "Touch", "View"]
