"""Intrinsic contact sensing: gravity compensation, tare, onset detection and contact location from wrenches.

From the raw log of a wrist sensor, in the frame of the grasped peg, to the contact location. Here the log is
simulated: a tool of 0.8 kg, a sensor with a bias, and after two seconds a force of 6 N on the peg's side,
30 mm from its root:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from bcppl.contact.touch import Touch
    >>> from bcppl.contact.sensing.intrinsic import IntrinsicSensing
    >>> from bcppl.contact.sensing.load import ToolLoad, identify_load
    >>> from bcppl.contact.sensing.noise import noise_at_rest
    >>> from bcppl.contact.sensing.onset import OnsetDetector
    >>> from bcppl.geometry.extrusion import box_peg
    >>> from bcppl.contact.sensing.location import ContactSensing
    >>> rng = np.random.default_rng(1)
    >>> def reading(wrench):
    ...     zero = [3.0, -2.0, 5.0, 0.1, -0.2, 0.05]
    ...     return wrench + zero + rng.normal(size=wrench.shape) * ([0.1] * 3 + [0.003] * 3)
    >>> def poses(turns):
    ...     return np.concatenate([np.zeros((len(turns), 3)), turns.as_quat()[:, [3, 0, 1, 2]]], axis=1)
    >>> tool = ToolLoad(mass=0.8, center=(0.0, 0.01, 0.04))
    >>> peg, times = box_peg(0.016, 0.05), np.arange(300) / 100.0
    >>> held = poses(Rotation.from_rotvec(np.outer(np.linspace(0.0, 0.5, 300), [1, 0, 0])))
    >>> contact, force = np.array([0.008, 0.002, -0.03]), np.array([-6.0, 0.0, 0.5])
    >>> wrench = np.where(times[:, None] >= 2.0, np.concatenate([force, np.cross(contact, force)]), 0.0)
    >>> touch = Touch(times, reading(tool.weight(held) + wrench), held)

The load, from mean readings at rest in eight poses:

    >>> tilted = poses(Rotation.random(8, rng=rng))
    >>> static = np.mean([reading(tool.weight(tilted)) for _ in range(100)], axis=0)
    >>> load = identify_load(static, tilted).load
    >>> print(f"{load.mass:.2f} kg")
    0.80 kg

Gravity compensation and tare, then onset detection. The wrenches of the tare are NaN, which the detector
ignores:

    >>> sensing = ContactSensing(peg, rate=100.0, tare=50, load=load)
    >>> wrench = sensing.tared([touch])[0].numpy()
    >>> (onset,) = OnsetDetector(rest=50).onsets(times, wrench[:, :3])
    >>> print(f"at {onset.time:.3f} +- {onset.standard_deviation:.3f} s, detected in row {onset.alarm}")
    at 1.995 +- 0.003 s, detected in row 200

The location, from the mean of 50 samples in contact, with the noise of these and of the 50 of the tare:

    >>> noise = noise_at_rest(wrench[50:190])
    >>> rows = slice(onset.alarm + 5, onset.alarm + 55)
    >>> candidates = IntrinsicSensing(peg, friction=0.5).candidates(
    ...     wrench[rows].mean(axis=0)[None], noise.covariance(1 / 50 + 1 / 50)
    ... )
    >>> location, covariance = candidates.location[0, 0], candidates.covariance[0, 0]
    >>> print(f"{candidates.probability[0, 0]:.2f} at", np.round(1e3 * location, 1), "mm")
    1.00 at [  8.    2.1 -30.1] mm
    >>> print("+-", np.round(1e3 * np.sqrt(np.diagonal(covariance)), 1), "mm")
    +- [0.  0.1 0.1] mm
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
