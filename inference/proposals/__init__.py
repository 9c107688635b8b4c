"""Proposals: programs that sample new values at latent addresses."""

from bcppl.inference.proposals.ancestral import prior
from bcppl.inference.proposals.contact_points import contact_alignment
from bcppl.inference.proposals.density import independent
from bcppl.inference.proposals.depth_points import depth_alignment
from bcppl.inference.proposals.differences import differential_evolution
from bcppl.inference.proposals.proposal import Fitted, Program, Proposal, program_of
from bcppl.inference.proposals.spread import spread_of
from bcppl.inference.proposals.symmetries import Continuous, rotations, symmetry
from bcppl.inference.proposals.walk import drift, joint_drift

__all__ = [
    "Continuous",
    "Fitted",
    "Program",
    "Proposal",
    "contact_alignment",
    "depth_alignment",
    "differential_evolution",
    "drift",
    "independent",
    "joint_drift",
    "prior",
    "program_of",
    "rotations",
    "spread_of",
    "symmetry",
]
