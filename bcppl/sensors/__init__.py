"""Sensors: one file for each kind of measurement, and the protocol that they share."""
