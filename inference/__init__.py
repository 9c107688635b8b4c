"""Inference programs and the pieces they are made of; `infer` runs the one that suits a model best."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
