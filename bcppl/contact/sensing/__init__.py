"""From a wrench to what was touched: the tool's weight, the onset, and where the force enters the peg.

From the raw log of a wrist sensor, in the frame of the peg that it holds, to where the peg is touched. Here
the log is made up: 0.8 kg hang on the sensor, which is not at zero, and after two seconds something pushes
against the peg's side, 30 mm from its root, with 6 N:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from bcppl.contact.touch import Touch
    >>> from bcppl.contact.sensing.intrinsic import IntrinsicSensing
    >>> from bcppl.contact.sensing.load import ToolLoad, identify_load
    >>> from bcppl.contact.sensing.noise import noise_at_rest
    >>> from bcppl.contact.sensing.onset import OnsetDetector
    >>> from bcppl.geometry.extrusion import box_peg
    >>> from bcppl.contact.wrench import Sensing
    >>> rng = np.random.default_rng(1)
    >>> def read(wrench):
    ...     zero = [3.0, -2.0, 5.0, 0.1, -0.2, 0.05]
    ...     return wrench + zero + rng.normal(size=wrench.shape) * ([0.1] * 3 + [0.003] * 3)
    >>> def poses(turns):
    ...     return np.concatenate([np.zeros((len(turns), 3)), turns.as_quat()[:, [3, 0, 1, 2]]], axis=1)
    >>> tool = ToolLoad(mass=0.8, center=(0.0, 0.01, 0.04))
    >>> peg, times = box_peg(0.016, 0.05), np.arange(300) / 100.0
    >>> held = poses(Rotation.from_rotvec(np.outer(np.linspace(0.0, 0.5, 300), [1, 0, 0])))
    >>> contact, force = np.array([0.008, 0.002, -0.03]), np.array([-6.0, 0.0, 0.5])
    >>> felt = np.where(times[:, None] >= 2.0, np.concatenate([force, np.cross(contact, force)]), 0.0)
    >>> touch = Touch(times, read(tool.weight(held) + felt), held)

The load, from the means of readings at rest in eight poses:

    >>> tilted = poses(Rotation.random(8, rng=rng))
    >>> still = np.mean([read(tool.weight(tilted)) for _ in range(100)], axis=0)
    >>> load = identify_load(still, tilted).load
    >>> print(f"{load.mass:.2f} kg")
    0.80 kg

Weight and zero off, then the onset. The wrenches that the zero is taken from come out as NaN, and the
detector passes over them:

    >>> sensing = Sensing(peg, rate=100.0, tare=50, load=load)
    >>> wrench = sensing.tared([touch])[0].numpy()
    >>> (onset,) = OnsetDetector(rest=50).onsets(times, wrench[:, :3])
    >>> print(f"at {onset.time:.3f} s, known to {onset.spread:.3f} s; noticed in row {onset.alarm}")
    at 1.995 s, known to 0.003 s; noticed in row 200

And where, from the mean of 50 samples in contact. Its noise is that of 50 samples, and of the 50 of the zero:

    >>> noise = noise_at_rest(wrench[50:190])
    >>> rows = slice(onset.alarm + 5, onset.alarm + 55)
    >>> found = IntrinsicSensing(peg, friction=0.5).candidates(
    ...     wrench[rows].mean(axis=0)[None], noise.covariance(1 / 50 + 1 / 50)
    ... )
    >>> print(f"{found.probability[0, 0]:.2f} at", np.round(1e3 * found.location[0, 0], 1), "mm")
    1.00 at [  8.    2.1 -30.1] mm
    >>> print("known to", np.round(1e3 * np.sqrt(np.diagonal(found.covariance[0, 0])), 1), "mm")
    known to [0.  0.1 0.1] mm
"""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
