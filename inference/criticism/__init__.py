"""Criticism of a model, given its posterior: predictive checks, rival hypotheses, and what is left open.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling
    from bcppl.inference.criticism import surprise

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    print(surprise(population))  # p values, by address

`hypotheses` compares a part with its mirror image and with turned ones by evidence, `undetermined` names the
direction in which touches leave a position open, `shared_errors` how grasp, arm and clock are off, and
`explanations` what else would explain touches: a late wrench, a turned peg, a part that moved.
"""

from bcppl.inference.criticism.nuisances import SharedError, SuddenChange, shared_errors, sudden_changes
from bcppl.inference.criticism.predictive import surprise
from bcppl.inference.criticism.rival_hypotheses import Explanation, explanations

__all__ = [
    "Explanation",
    "SharedError",
    "SuddenChange",
    "explanations",
    "shared_errors",
    "sudden_changes",
    "surprise",
]
