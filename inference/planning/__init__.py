"""Motion planning of touches, searches and insertions around a belief over the part's pose."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
