"""The bench of the accuracy benchmark and of those beside it: its scenes, parts, arm and errors."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
