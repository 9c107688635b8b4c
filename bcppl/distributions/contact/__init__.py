"""Likelihoods of a held peg's probe: contact locations, peg poses and wrenches.

Each compares a window of a recording with the tracks that a simulator predicts for the particles' poses.
"""

from bcppl.distributions.contact.locations import ChamferContacts, ContactsInTime, chamfer
from bcppl.distributions.contact.peg_pose import PegPose
from bcppl.distributions.contact.track import Track, TrackDistribution
from bcppl.distributions.contact.wrench import Wrench

__all__ = ["ChamferContacts", "ContactsInTime", "PegPose", "Track", "TrackDistribution", "Wrench", "chamfer"]
