"""SE(3): batched poses, their tangent space and their base measure.

A pose is `[x, y, z, qw, qx, qy, qz]`, metres and a unit quaternion, in the last dimension of a float64
tensor; q and -q are the same pose. A pose is named after the frames that it maps between:
`world_from_part` maps points of the part's frame to the world's.

The tangent space at a pose is R^3 x so(3), translation and rotation apart: a tangent `[v, w]` moves the
translation by v (in the frame the pose maps to, metres) and turns the rotation by the rotation vector w
(in the frame the pose maps from, radians): (t, R) -> (t + v, R Exp(w)).

Every pose density in bcppl is with respect to Lebesgue measure on the free translations times the
normalised Haar measure on the free rotations, and every one takes its Jacobian from here.
"""

from bcppl.poses.se3 import (
    FREE,
    Freedom,
    as_pose,
    compose,
    exp,
    from_rotation_matrix,
    from_rotation_vector,
    from_translation_quaternion_xyzw,
    identity,
    inverse,
    local,
    log,
    log_haar_density_of_rotation_vector,
    log_volume_of_twist,
    quaternion_xyzw,
    retract,
    right_jacobian,
    rotation_matrix,
    transform,
    twist_of,
)

__all__ = [
    "FREE",
    "Freedom",
    "as_pose",
    "compose",
    "exp",
    "from_rotation_matrix",
    "from_rotation_vector",
    "from_translation_quaternion_xyzw",
    "identity",
    "inverse",
    "local",
    "log",
    "log_haar_density_of_rotation_vector",
    "log_volume_of_twist",
    "quaternion_xyzw",
    "retract",
    "right_jacobian",
    "rotation_matrix",
    "transform",
    "twist_of",
]
