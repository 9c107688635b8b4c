"""Measurements on disk: what a recording holds, its native file, its checks, and the importers."""

from bcppl.contact.touch import Touch
from bcppl.geometry.guess import Guess
from bcppl.recordings.check import notes, problems, validate
from bcppl.recordings.describe import describe
from bcppl.recordings.file import load, save
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.measurements import DepthImage, Measurement, Push, Recording, View

__all__ = [
    "DepthImage",
    "Guess",
    "Measurement",
    "Probe",
    "ProbeWindow",
    "Push",
    "Recording",
    "Touch",
    "View",
    "describe",
    "load",
    "notes",
    "problems",
    "save",
    "validate",
]
