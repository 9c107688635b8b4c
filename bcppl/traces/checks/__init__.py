"""Checks of a program: is it one that traces, weights and kernels are right for?

    import pyro, torch
    import pyro.distributions as dist
    from bcppl.traces import check_program

    def program():
        x = pyro.sample("x", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.Normal(x - x.mean(), 0.3))

    check_program(program, (), {"y": 0.2})
    # ProgramError: site 'y' has another log-probability at a particle where only other particles' ...

A program is run at values drawn from its prior, again at the same values, at other particles' values, in
another order, for fewer particles, and by `update` instead of a new run; its draws are compared with its
densities, its gradients with differences. The first mistake that shows raises a `ProgramError`, whose
`fault` is its kind and whose `site` is the address. Each module states what it compares.
"""

from bcppl.traces.checks.program import check_program
from bcppl.traces.faults import Fault, ProgramError

__all__ = ["Fault", "ProgramError", "check_program"]
