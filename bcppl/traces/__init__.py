"""Traces: runs of a program for N particles at once, and the verbs on them."""

from bcppl.traces.carried import carried
from bcppl.traces.checks import Fault, ProgramError, check_program
from bcppl.traces.model import Model
from bcppl.traces.series import Series
from bcppl.traces.trace import Trace
from bcppl.traces.update import Regenerated, Update, extend, regenerate, update
from bcppl.traces.verbs import Proposed, assess, generate, propose, simulate

__all__ = [
    "Fault",
    "Model",
    "ProgramError",
    "Proposed",
    "Regenerated",
    "Series",
    "Trace",
    "Update",
    "assess",
    "carried",
    "check_program",
    "extend",
    "generate",
    "propose",
    "regenerate",
    "simulate",
    "update",
]
