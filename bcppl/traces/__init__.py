"""Traces: runs of a program for N particles at once, and the verbs on them.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.traces import generate, update

    def weighed(times):
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        for k in range(times):
            pyro.sample(f"reading_{k}", dist.Normal(mass, 0.3))

    trace, log_weight = generate(weighed, (1,), {"reading_0": torch.tensor(2.4).double()}, particles=1000)
    print(trace["mass"].shape, trace.log_prob("reading_0").shape)
    again = update(trace, args=(2,), observations={"reading_1": torch.tensor(2.1).double()})
    print(again.log_ratio.shape)  # log-probability of the second reading

A program is a Pyro program, run under one plate of particles; `Series` runs step by step.
"""

from bcppl.traces.carried import carried
from bcppl.traces.checks import Fault, ProgramError, check_program
from bcppl.traces.differentiation.graph import gradients
from bcppl.traces.model import Model
from bcppl.traces.run import Program
from bcppl.traces.series import Series
from bcppl.traces.structural import Structure, structural
from bcppl.traces.trace import Trace
from bcppl.traces.update import Regenerated, Update, extend, regenerate, update
from bcppl.traces.verbs import Proposed, assess, generate, propose, simulate

__all__ = [
    "Fault",
    "Model",
    "Program",
    "ProgramError",
    "Proposed",
    "Regenerated",
    "Series",
    "Structure",
    "Trace",
    "Update",
    "assess",
    "carried",
    "check_program",
    "extend",
    "generate",
    "gradients",
    "propose",
    "regenerate",
    "simulate",
    "structural",
    "update",
]
