"""Pictures of a belief, of a run, of images and of touches.

Pictures of a whole are matplotlib `Figure`s of their own, made without pyplot: nothing is shown or kept in a
global state, and `figure.savefig("name.png")` works without a display. The others draw into axes that they
are given, and give them back.
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
