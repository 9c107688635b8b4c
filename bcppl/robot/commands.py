"""Commands over time: of a probe between its knots, and of a plan of which some motions were stopped."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Plan

STEP = 0.005  # s between the command's poses
ROUNDED = 8  # steps over which corners are rounded: 40 ms


def interpolated_command(probe: Probe, times: Array) -> tuple[Array, Array]:
    """Commanded poses (S, 7) and twists (S, 6) of a probe at times (S,), in seconds.

    Translations are interpolated linearly and rotations along the geodesic, so that the twist, in the
    commanded peg's axes (m/s, rad/s), is constant between two command times. The last pose is held.
    """
    knots, poses = probe.command_times, np.asarray(probe.command, dtype=np.float64)
    turns = Rotation.from_quat(poses[:, [4, 5, 6, 3]])
    if len(knots) == 1:
        return np.repeat(poses, len(times), axis=0), np.zeros((len(times), 6))
    spans = np.diff(knots)
    speed = np.diff(poses[:, :3], axis=0) / spans[:, None]
    spin = (turns[:-1].inv() * turns[1:]).as_rotvec() / spans[:, None]
    # A step that starts within a rounding error before a knot belongs to the next segment.
    segment = np.clip(np.searchsorted(knots, times + 1e-9, side="right") - 1, 0, len(spans) - 1)
    elapsed = np.clip(times - knots[segment], 0.0, spans[segment])
    rotation = turns[segment] * Rotation.from_rotvec(spin[segment] * elapsed[:, None])
    pose = np.empty((len(times), 7))
    pose[:, :3] = poses[segment, :3] + speed[segment] * elapsed[:, None]
    pose[:, 3:] = rotation.as_quat()[:, [3, 0, 1, 2]]
    twist = np.concatenate([rotation.inv().apply(speed[segment]), spin[segment]], axis=1)
    twist[times > knots[-1] - 1e-9] = 0.0
    return pose, twist


def stamps_of(plan: Plan) -> Array:
    """The times (T,) of a plan's samples, s, up to its last knot and without it."""
    duration = float(plan.times[-1] - plan.times[0])
    return np.asarray(plan.times[0] + np.arange(round(duration * plan.rate)) / plan.rate)


def command_of(plan: Plan, stops: Mapping[int, float]) -> Probe:
    """The command of a plan of which some guarded motions and searches are stopped early.

    Corners are rounded: the command is the mean of the plan's last 40 ms. So it is 20 ms late, stops within
    40 ms, and never depends on later contacts. A corner at which the velocity changes by 100 mm/s takes 0.5 N
    to accelerate the 0.2 kg of the tool; others in proportion.

    Args:
        plan: of the arm.
        stops: when (s) a guarded or searching motion is stopped, by its number in the plan.
    """
    found = False  # the hole: the remaining motions of the search are skipped
    times, ends = [float(plan.times[0])], [plan.world_from_peg[0]]
    shift, turn = np.zeros(3), Rotation.identity()  # of the motions that follow, by the skipped ones
    for k, manner in enumerate(plan.manners):
        if manner == "free":
            shift, turn = np.zeros(3), Rotation.identity()
        planned = plan.world_from_peg[k + 1]
        end = np.concatenate([planned[:3] + shift, _quaternion(_rotation(planned) * turn)])
        found = found and manner == "searching"
        if found:
            end = ends[-1]
            shift, turn = end[:3] - planned[:3], _rotation(planned).inv() * _rotation(end)
        elif k in stops:
            found = manner == "searching"
            path = _path(plan, np.array([times[-1], plan.times[k + 1]]), np.stack([ends[-1], end]))
            end = interpolated_command(path, np.array([stops[k]]))[0][0]
            shift, turn = end[:3] - planned[:3], _rotation(planned).inv() * _rotation(end)
            times.append(stops[k])
            ends.append(end)
        times.append(float(plan.times[k + 1]))
        ends.append(end)
    count = round((plan.times[-1] - plan.times[0]) / STEP)
    fine = plan.times[0] + STEP * np.arange(count + 1)
    led = interpolated_command(_path(plan, np.array(times), np.stack(ends)), fine)[0]
    opposite = np.cumprod(np.sign(np.sum(led[1:, 3:] * led[:-1, 3:], axis=1)))
    led[1:, 3:] *= opposite[:, None]
    late = np.concatenate([np.repeat(led[:1], ROUNDED - 1, axis=0), led])
    mean = np.lib.stride_tricks.sliding_window_view(late, ROUNDED, axis=0).mean(axis=-1)
    mean[:, 3:] /= np.linalg.norm(mean[:, 3:], axis=1, keepdims=True)
    return Probe(plan.name, fine, mean, plan.stiffness, plan.damping, stamps_of(plan))


def continued(before: Probe, after: Probe, time: float) -> Probe:
    """The later of two commands, equal to the earlier one up to a time, to the bit."""
    given = before.command_times <= time + 1e-9
    after.command[given] = before.command[given]
    return after


def _path(plan: Plan, times: Array, world_from_peg: Array) -> Probe:
    """Straight motions between poses (K, 7) at times of which some may coincide."""
    apart = np.append(np.diff(times) > 1e-9, True)
    return Probe(plan.name, times[apart], world_from_peg[apart], plan.stiffness, plan.damping, times[:1])


def _rotation(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[[4, 5, 6, 3]])


def _quaternion(rotation: Rotation) -> Array:
    return np.asarray(rotation.as_quat()[[3, 0, 1, 2]])
