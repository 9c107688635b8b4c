"""Point-finger pushes of R. Zhou's MLab_EXP logs, pooled into one static problem with a known answer.

A log holds pushes of an aluminium triangular prism by a point finger, with the object's pose by motion
capture. Every push starts with the object at rest, so pushes are put together in the object's frame and the
object is then set at one pose, drawn from the prior. Source: github.com/robinzhoucmu/MLab_EXP,
PushExp/sensor_log, Apache-2.0.
"""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl.arguments import LARGEST_SEED, number_within
from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.parts import Guess, Part, Piece
from bcppl.poses import as_pose, compose, identity, inverse, rotation_matrix
from bcppl.sensors import Measurement, Push, Recording

NAME = "point-probe"
HELP = "Point-finger pushes on a triangular prism (MLab_EXP logs), the prism at a random known pose."

SOURCE = (
    "R. Zhou, github.com/robinzhoucmu/MLab_EXP, PushExp/sensor_log, Apache-2.0; "
    "pushes pooled in the object's frame and set at a random pose"
)
LEG, THICKNESS = 0.150, 0.050  # m, the prism's
TARE_ROWS = 10  # rows at a push's start that are free of contact
ONSET = 0.6  # N: contact begins where the tared force exceeds it

# The sensor's axes lie at 45 degrees to the tool's and one is flipped.
TOOL_FROM_SENSOR = math.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])


@dataclass(frozen=True, eq=False)
class LoggedPush:
    """One push as logged, in SI units; times count from its first force.

    Attributes:
        base_from_object: (7,) the object at rest before the push, in the robot's base frame.
        force_times: (T,) seconds.
        force: (T, 2) raw force in the sensor's axes, N.
        tip_times: (R,) seconds.
        base_from_tip: (R, 7) the finger's tip.
    """

    base_from_object: Tensor
    force_times: Array
    force: Array
    tip_times: Array
    base_from_tip: Tensor

    @property
    def onset(self) -> int | None:
        """The first row whose tared force exceeds 0.6 N; None where nothing was touched."""
        tared = self.force - self.force[:TARE_ROWS].mean(axis=0)
        touched = np.flatnonzero(np.hypot(tared[:, 0], tared[:, 1]) > ONSET)
        return int(touched[0]) if touched.size else None


def prism() -> Part:
    """The aluminium triangle: right-angle corner at the origin, legs along x and y, from z = 0 upwards."""
    corners = np.array([[0.0, 0.0], [LEG, 0.0], [0.0, LEG]])
    vertices = np.array([[x, y, z] for z in (0.0, THICKNESS) for x, y in corners])
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    return Part(
        name="aluminium triangle",
        vertices=vertices,
        faces=np.array(faces, dtype=np.int64),
        pieces=(Piece("hull", vertices),),
        source=SOURCE,
    )


def read_log(path: Path) -> list[LoggedPush]:
    """The pushes of one log.

    Raises:
        InputError: the file is missing, is no list of numbers, or does not hold the rows that it announces.
    """
    try:
        text = path.read_bytes().decode("ascii")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy warns of what it cannot read, and leaves it out
            numbers = np.fromstring(text, dtype=np.float64, sep=" ")
    except (OSError, ValueError, DeprecationWarning) as error:
        raise InputError(f"{path} is no push log of whitespace-separated numbers; give one.") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{path} holds a number that is not finite; copy the log again.")
    place = 0

    def take(rows: float, columns: int) -> Array:
        nonlocal place
        end = place + int(rows) * columns
        if rows < 0 or rows != int(rows) or end > len(numbers):
            raise InputError(f"{path} ends in the middle of a push, or is no MLab_EXP log; copy it again.")
        place, block = end, numbers[place:end]
        return block.reshape(int(rows), columns)

    pushes: list[LoggedPush] = []
    for _ in range(int(take(1, 1)[0, 0])):
        before, _after = take(2, 7)
        forces = take(take(1, 1)[0, 0], 3)
        tips = take(take(1, 1)[0, 0], 8)
        if len(forces) <= TARE_ROWS or len(tips) == 0:
            raise InputError(f"{path}: push {len(pushes)} holds too few rows to tare; copy the log again.")
        pushes.append(
            LoggedPush(
                base_from_object=_pose(before, path),
                force_times=forces[:, 0] - forces[0, 0],
                force=np.ascontiguousarray(forces[:, 1:]),
                tip_times=tips[:, 0] - forces[0, 0],
                base_from_tip=_pose(tips[:, 1:], path),
            )
        )
    if place != len(numbers):
        raise InputError(f"{path} holds more numbers than its pushes; give a MLab_EXP log.")
    return pushes


def _pose(millimetres: Array, path: Path) -> Tensor:
    """Poses of rows x y z (mm) qw qx qy qz, whose logged quaternions are rounded."""
    length = np.linalg.norm(millimetres[..., 3:], axis=-1, keepdims=True)
    if (np.abs(length - 1) > 0.01).any():
        raise InputError(f"{path} holds a quaternion that is not of unit length, or is no MLab_EXP log.")
    quaternions = millimetres[..., 3:] / length
    return as_pose(np.concatenate([1e-3 * millimetres[..., :3], quaternions], axis=-1))


def force_on_object(push: LoggedPush) -> Array:
    """The raw force (T, 3) that the finger exerts on the object, in the base frame's axes, N.

    The force along the finger is not sensed. The tip keeps its orientation during a push (within 0.12
    degrees), so one rotation turns all rows, and taring before or after it is the same.
    """
    quaternion = push.base_from_tip[0, [4, 5, 6, 3]].numpy()
    base_from_tool = Rotation.from_quat(quaternion).as_matrix()
    on_object = -push.force @ TOOL_FROM_SENSOR.T
    return np.asarray(np.pad(on_object, ((0, 0), (0, 1))) @ base_from_tool.T)


def measurement(push: LoggedPush, world_from_object: Tensor, after: float) -> Measurement:
    """A push as if the object had stood at `world_from_object` (7,), up to `after` seconds beyond contact.

    The wrench is what the object exerts on the finger, in the world's axes about the tip; torques and the
    force along the finger are not sensed and are 0.

    Raises:
        InputError: the push touches nothing.
    """
    onset = push.onset
    if onset is None:
        raise InputError("a push that touches nothing cannot be cut at its contact; leave it out.")
    end = push.force_times[onset] + after
    kept = push.force_times <= end
    path = np.searchsorted(push.tip_times, push.force_times[kept][-1]) + 1  # the path covers every wrench
    world_from_base = compose(world_from_object, inverse(push.base_from_object))
    force = -force_on_object(push)[kept] @ rotation_matrix(world_from_base).numpy().T
    return Measurement(
        Push(push.tip_times[:path], compose(world_from_base, push.base_from_tip[:path]).numpy()),
        Touch(push.force_times[kept], np.pad(force, ((0, 0), (0, 3))), np.zeros((0, 7))),
    )


def command(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="MLab_EXP push logs, pooled.")],
    pushes: Annotated[int, typer.Option(help="How many pushes to draw, without replacement.")] = 10,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the draws.")] = 0,
    translation: Annotated[float, typer.Option(help="Half width of the prior in x and y, m.")] = 0.02,
    yaw: Annotated[float, typer.Option(help="Half width of the prior in yaw, degrees.")] = 20.0,
    after: Annotated[float, typer.Option(help="How long to keep a push beyond its contact, s.")] = 0.5,
) -> Recording:
    """Pool random pushes, and set the object at a random pose in the prior.

    Raises:
        InputError: a log cannot be read, or holds fewer pushes with a contact than asked for.
    """
    touching = [push for log in logs for push in read_log(Path(log)) if push.onset is not None]
    if not 1 <= pushes <= len(touching):
        raise InputError(
            f"{pushes} pushes were asked for but {', '.join(map(str, logs))} holds {len(touching)} with a "
            f"contact; give other logs, or --pushes between 1 and {len(touching)}."
        )
    number_within("--translation is {} m", translation, least=0.0)
    number_within("--yaw is {} degrees", yaw, least=0.0, most=180.0)
    number_within("--after is {} s", after, least=0.0)
    rng = np.random.default_rng(seed)
    picked = rng.choice(len(touching), pushes, replace=False)
    x, y = rng.uniform(-translation, translation, 2)
    turn = math.radians(rng.uniform(-yaw, yaw))
    truth = torch.tensor([x, y, 0.0, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)], dtype=torch.float64)
    return Recording(
        part=prism(),
        guess=Guess(
            world_from_part=identity().numpy(),
            translation=np.array([translation, translation, 0.0]),
            yaw=math.radians(yaw),
        ),
        measurements=[measurement(touching[k], truth, after) for k in picked],
        truth=truth.numpy(),
        model="point_probe",
        source=SOURCE,
    )
