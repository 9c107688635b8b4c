"""Programs whose sites depend on a latent choice: particles in strata, one for each structure.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference.structures import generate_strata, probabilities
    from bcppl.traces import structural

    def summed():
        count = structural("count", dist.Categorical(torch.ones(3))) + 1
        terms = [pyro.sample(f"term_{j}", dist.Normal(torch.tensor(0.0), 1.0)) for j in range(count)]
        pyro.sample("y", dist.Normal(torch.stack(terms).sum(dim=0), 0.5))

    strata = generate_strata(summed, (), {"y": torch.tensor(2.0)}, particles=3000)
    print(probabilities(strata, "count"), strata.log_evidence)

Strata are resampled (`resample_strata`), given new measurements (`extend_strata`), tempered
(`tempered_strata`), and moved, within structures (`within`) and across them (`jump`; `check_move` tests it).
"""

from bcppl.inference.structures.allotment import resample_strata
from bcppl.inference.structures.branching import branch_strata, extend_strata
from bcppl.inference.structures.files import load_strata, save_strata
from bcppl.inference.structures.generation import generate_strata, sample_strata
from bcppl.inference.structures.jumps import Jump, jump
from bcppl.inference.structures.move_check import check_move
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
    "check_move",
    "extend_strata",
    "generate_strata",
    "in_turn",
    "jump",
    "load_strata",
    "mean",
    "probabilities",
    "resample_strata",
    "sample_strata",
    "save_strata",
    "tempered_strata",
    "translate",
    "within",
]
