"""Intrinsic contact sensing: onset and location of a contact from the wrenches of a wrist sensor."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
