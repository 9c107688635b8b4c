"""Intrinsic contact sensing: from the wrenches of a wrist sensor to the onset and the location of a contact."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
