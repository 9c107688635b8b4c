"""Sensors: one file for each kind of measurement, and the protocol that they share.

A kind is registered when its module is imported: here, one line for each, or from an installed package
by an entry point of the group "bcppl.sensors".
"""

from bcppl.sensors.depth import DepthImage, View
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.probe import Plan, Probe, ProbeWindow, Touch
from bcppl.sensors.protocol import Sensor, register, sensor_named, sensor_of, sensors
from bcppl.sensors.push import Push

__all__ = [
    "DepthImage",
    "Measurement",
    "Plan",
    "Probe",
    "ProbeWindow",
    "Push",
    "Recording",
    "Sensor",
    "Touch",
    "View",
    "register",
    "sensor_named",
    "sensor_of",
    "sensors",
]
