"""Planning: touches, slides, searches and insertions that an arm can carry out."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
