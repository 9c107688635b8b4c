"""Measurements on disk: the native file, its checks, and the importers."""

from bcppl.geometry.parts import Guess
from bcppl.recordings.check import describe, notes, problems, validate
from bcppl.recordings.file import load, save
from bcppl.recordings.repeated import once_each, repeated
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
    "once_each",
    "problems",
    "repeated",
    "save",
    "validate",
]
