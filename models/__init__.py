"""Generative programs: each a short file to copy and edit; worlds that simulate recordings; robots, parts."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
