"""Proposals: programs that sample new values at latent addresses."""

from bcppl.inference.proposals.ancestral import prior as prior
from bcppl.inference.proposals.contact_points import contact_alignment as contact_alignment
from bcppl.inference.proposals.density import independent as independent
from bcppl.inference.proposals.depth_points import depth_alignment as depth_alignment
from bcppl.inference.proposals.differences import differential_evolution as differential_evolution
from bcppl.inference.proposals.proposal import (
    Fitted as Fitted,
    Program as Program,
    Proposal as Proposal,
    program_of as program_of,
)
from bcppl.inference.proposals.spread import spread_of as spread_of
from bcppl.inference.proposals.symmetries import (
    Continuous as Continuous,
    rotations as rotations,
    symmetry as symmetry,
)
from bcppl.inference.proposals.walk import drift as drift, joint_drift as joint_drift
