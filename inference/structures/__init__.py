"""Programs whose sites depend on a latent choice: particles in strata, one for each structure.

def mixture(x):
count = structural("count", dist.Categorical(torch.ones(3))) + 1
means = [pyro.sample(f"mean_{j}", dist.Normal(0.0, 3.0)) for j in range(count)]
...

strata = generate_strata(mixture, (x,), {"y": y}, particles=3000)
print(probabilities(strata, "count"), strata.log_evidence)
"""

from bcppl.inference.structures.allotment import resample_strata
from bcppl.inference.structures.branching import branch_strata, extend_strata
from bcppl.inference.structures.generation import generate_strata, sample_strata
from bcppl.inference.structures.jumps import Jump, jump
from bcppl.inference.structures.moves import MovedStrata, StrataMove, by_structure, in_turn, within
from bcppl.inference.structures.strata import Strata, mean, probabilities
from bcppl.inference.structures.tempering import (
    SteppedStrata,
    StrataInfo,
    TemperedStrata,
    tempered_strata,
)
from bcppl.inference.structures.translation import translate

__all__ = [
    "Jump",
    "MovedStrata",
    "SteppedStrata",
    "Strata",
    "StrataInfo",
    "StrataMove",
    "TemperedStrata",
    "branch_strata",
    "by_structure",
    "extend_strata",
    "generate_strata",
    "in_turn",
    "jump",
    "mean",
    "probabilities",
    "resample_strata",
    "sample_strata",
    "tempered_strata",
    "translate",
    "within",
]
