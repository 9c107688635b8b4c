"""Where to touch next: candidates ranked by their expected entropy reduction."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
