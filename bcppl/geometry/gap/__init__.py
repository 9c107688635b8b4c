"""The gap between a held peg and a part, for many poses of the part, without simulation.

The gap is the gap function of contact mechanics: the signed minimum distance of two bodies, negative where
they penetrate. The peg's pose is known from the robot's joints, so a pose of the part predicts the gap: about
zero at a contact and positive elsewhere.
"""

from __future__ import annotations

from bcppl.geometry.gap.frames import Frames, frames_of
from bcppl.geometry.gap.peg_gap import Gap, PegGap

__all__ = ["Frames", "Gap", "PegGap", "frames_of"]
