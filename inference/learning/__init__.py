"""Learning for inference: trained proposals, networks that read measurements, adapted kernels."""

from bcppl.inference.learning.amortised import Amortised
from bcppl.inference.learning.bridging import bridged
from bcppl.inference.learning.hmc_adaptation import adaptive_hmc
from bcppl.inference.learning.objectives import evidence_bound, forward_kl
from bcppl.inference.learning.training import Checks, Trained, train

__all__ = [
    "Amortised",
    "Checks",
    "Trained",
    "adaptive_hmc",
    "bridged",
    "evidence_bound",
    "forward_kl",
    "train",
]
