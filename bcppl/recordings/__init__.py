"""Measurements on disk: the native file, its checks, and the importers."""

from bcppl.geometry.parts import Guess
from bcppl.recordings.check import describe, notes, problems, validate
from bcppl.recordings.file import load, save
from bcppl.sensors import DepthImage, Measurement, Probe, ProbeWindow, Push, Recording, Touch, View

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
