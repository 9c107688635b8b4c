"""Intrinsic contact sensing: gravity compensation, tare, onset detection and contact location from wrenches."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
