"""Worlds: what simulates recordings, with parameters of its own that inference does not know."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
