"""Traces: runs of a program for N particles at once, and the verbs on them."""

from bcppl.traces.carried import carried
from bcppl.traces.model import Model
from bcppl.traces.trace import Trace
from bcppl.traces.verbs import Proposed, Update, assess, extend, generate, propose, simulate, update

__all__ = [
    "Model",
    "Proposed",
    "Trace",
    "Update",
    "assess",
    "carried",
    "extend",
    "generate",
    "propose",
    "simulate",
    "update",
]
