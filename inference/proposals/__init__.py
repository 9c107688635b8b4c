"""Proposals: programs that choose new values at latent addresses."""

from bcppl.inference.proposals.proposal import Fitted, Program, Proposal, program_of
from bcppl.inference.proposals.walk import drift, spread_of

__all__ = ["Fitted", "Program", "Proposal", "drift", "program_of", "spread_of"]
