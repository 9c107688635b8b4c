"""Worlds: simulators of recordings, with parameters of their own that inference does not know."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
