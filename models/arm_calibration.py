"""An arm's kinematics are calibrated by a ball that is seated in sockets at unknown positions.

A ball on the flange is seated in a socket and the arm moves through many postures in which the ball stays
in place; the joint angles are recorded. By the nominal URDF the ball moves by millimetres. Latent are the
encoders' offsets (`offsets`), the position of the ball on its link (`ball`), the errors of the joints'
origins (`errors`), and the scatter of the seated ball (`noise`). The socket's position is integrated out
under a flat prior, so a rotation of the whole arm about its base keeps its prior.

The measurements are angles, so the density of the ball's position needs the volume sqrt(det J J^T) of the map
from angles to positions. Without it a smaller arm, whose ball moves less, would have a larger likelihood: on
real recordings all distances came 0.1 mm too short. Idea and recordings: MUKCa, platonics-delft/
kinematics_calibration.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from scipy.linalg import helmert
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl.arrays import Array
from bcppl.errors import InputError, reason_of
from bcppl.robot.inverse_kinematics import driven_joints
from bcppl.robot.kinematics import Robot
from bcppl.traces import Trace

FEWEST = 3  # seatings


@dataclass(frozen=True, eq=False)
class Arm:
    """The prior of an arm and its ball.

    Attributes:
        robot: the nominal arm.
        link: whose origin is the ball's nominal centre; a fixed joint leads to it, where a URDF file states
            the ball's position.
        offset: standard deviation of the encoders' offsets, radians.
        shift, turn: standard deviations of the errors of the joints' origins, metres and radians; with both 0
            the URDF is exact, and there is no site `errors`.
        mount: standard deviation of the ball's centre about its nominal position, metres.
        noise: median of the scatter of a seated ball along each axis, metres; known within a factor of four.

    Raises:
        InputError: the robot has no such link, or a joint moves it.
    """

    robot: Robot
    link: str = "ball_link"
    offset: float = 0.01
    shift: float = 0.001
    turn: float = 0.005
    mount: float = 0.003
    noise: float = 0.0003

    def __post_init__(self) -> None:
        seat = self.robot.joint_to(self.link)
        if seat.kind != "fixed":
            raise InputError(
                f"joint {seat.name!r} of {self.robot.name} moves the ball's link {self.link!r}, so that no "
                "URDF file can state where the ball is on it; add a link at the ball, on a fixed joint."
            )

    @property
    def spread(self) -> Mapping[str, Tensor]:
        """Prior standard deviations of the latent values, all but the noise's."""
        joints = len(self.robot.joints)
        spread = {"offsets": torch.full((joints,), self.offset), "ball": torch.full((3,), self.mount)}
        if self.shift or self.turn:
            spread["errors"] = torch.tensor([self.shift] * 3 + [self.turn] * 3).expand(joints, 6)
        return {address: value.to(torch.float64) for address, value in spread.items()}

    def positions(self, values: Mapping[str, Tensor], angles: Tensor) -> Tensor:
        """Positions (N, T, 3) of the ball, metres, by latent values and angles (T, J)."""
        offsets, ball = values["offsets"], values["ball"]
        return self.robot.position(self.link, angles, offsets, ball, values.get("errors"))

    def log_volume(self, values: Mapping[str, Tensor], angles: Tensor) -> Tensor:
        """Log-volume (N,) of the map from angles to positions, summed over the stamps.

        Raises:
            InputError: the number of angles is not that of the joints.
        """
        joints = self.robot.joints
        if angles.shape[-1] != len(joints):
            raise InputError(
                f"a seating of {self.robot.name} has {angles.shape[-1]} angles for each stamp; give "
                f"{len(joints)}, in the order {', '.join(joint.name for joint in joints)}."
            )
        offsets = values["offsets"]
        kept = torch.is_grad_enabled() and any(v.requires_grad for v in values.values())
        with torch.enable_grad():
            moved = offsets[:, None].expand(-1, *angles.shape).clone()
            moved = moved if kept and moved.requires_grad else moved.detach().requires_grad_()
            positions = self.positions({**values, "offsets": moved}, angles)
            rows = [
                torch.autograd.grad(positions[..., k].sum(), moved, create_graph=kept, retain_graph=True)[0]
                for k in range(3)
            ]
            jacobian = torch.stack(rows, dim=-2)  # (N, T, 3, J)
            return 0.5 * torch.logdet(jacobian @ jacobian.mT).sum(dim=1)


def arm_calibration(arm: Arm, seatings: Sequence[Tensor]) -> None:
    """The program: the arm's kinematic errors, then the deviations of the ball's positions per seating."""
    values = {
        address: pyro.sample(address, dist.Normal(torch.zeros_like(spread), spread).to_event(spread.ndim))
        for address, spread in arm.spread.items()
    }
    noise = pyro.sample("noise", dist.LogNormal(torch.tensor(np.log(arm.noise)), 0.7))
    for k, angles in enumerate(seatings):
        # Orthonormal contrasts of the stamps: the data without their common mean, which is unknown.
        contrasts = torch.from_numpy(helmert(len(angles))) @ arm.positions(values, angles)
        pyro.sample(f"seating_{k}", dist.Normal(contrasts, noise[:, None, None]).to_event(2))
        pyro.factor(f"volume_{k}", arm.log_volume(values, angles))


def observations(seatings: Sequence[Tensor]) -> Mapping[str, Tensor]:
    """The observed contrasts (T - 1, 3): zero, since a seated ball does not move."""
    return {f"seating_{k}": torch.zeros(len(q) - 1, 3).double() for k, q in enumerate(seatings)}


def sockets(arm: Arm, trace: Trace, angles: Tensor) -> Tensor:
    """Draws (N, 3) of a socket's position, metres, from angles (T, J) of a ball seated in it."""
    mean = arm.positions(trace.choices, angles).mean(dim=1)
    return mean + trace["noise"][:, None] / len(angles) ** 0.5 * torch.randn_like(mean)


class RemainingError(NamedTuple):
    """What a calibration leaves uncertain, metres.

    Attributes:
        before, after: root mean square distance of the seated ball from its mean, by the nominal arm and by
            the calibrated one.
        deviation: standard deviation of the ball's position along an axis, the scatter included, apart from
            where the whole arm stands.
        length: over which that error changes: a Gaussian process with a squared exponential covariance.
    """

    before: float
    after: float
    deviation: float
    length: float


def require_sockets(seatings: Sequence[Tensor]) -> None:
    """Raise InputError where there are too few sockets for an arm's errors to be known from their places."""
    if len(seatings) < FEWEST:
        raise InputError(
            f"an arm cannot be calibrated by {len(seatings)} seating{'s' * (len(seatings) != 1)}, which a "
            f"motion of the whole arm explains; seat the ball in {FEWEST} sockets at least, far apart."
        )


def remaining_error(
    arm: Arm, calibrated: Robot, draws: Trace, weights: Tensor, seatings: Sequence[Tensor]
) -> RemainingError:
    """What is left uncertain over the workspace of the seatings.

    Args:
        arm: its prior.
        calibrated: the arm as it was written (`corrected_joints`).
        draws: N of the posterior.
        weights: (N,) of the draws, with a sum of 1.
        seatings: angles (T, J) of each.

    Raises:
        InputError: there are fewer than three seatings.
    """
    require_sockets(seatings)
    latent = {address: draws[address] for address in arm.spread}
    mean = {a: torch.einsum("n,n...->...", weights, value)[None] for a, value in latent.items()}

    def scatter(robot: Robot) -> float:
        each = [robot.position(arm.link, q) for q in seatings]
        squares = torch.cat([(x - x.mean(dim=0)).square().sum(dim=1) for x in each])
        return float(squares.mean().sqrt())

    # One posture of each seating: how it is seated adds as much as the calibration leaves.
    postures = torch.stack([q[0] for q in seatings])
    place = arm.positions(mean, postures)[0]
    # A motion of the whole arm has 6 degrees of freedom of the 3 T that places have, and fits that much.
    error = _bent(place, arm.positions(latent, postures) - place) / math.sqrt(1.0 - 2.0 / len(place))
    variance = float(torch.einsum("n,nti->ti", weights, error.square()).mean())
    after = scatter(calibrated)
    first, second = torch.triu_indices(len(place), len(place), 1)
    apart = (place[first] - place[second]).norm(dim=1)
    covered = torch.einsum("n,nti,nti->t", weights, error[:, first], error[:, second]) / 3.0
    correlation = (covered / max(variance, 1e-30)).clamp(1e-3, 1.0 - 1e-9)
    # exp(-r^2 / 2 l^2) by least squares of its logarithm, through the origin.
    curvature = float((-2.0 * correlation.log() * apart**2).sum() / (apart**4).sum())
    length = 1.0 / math.sqrt(max(curvature, 1e-4))
    return RemainingError(scatter(arm.robot), after, math.sqrt(variance + after**2 / 3.0), min(length, 1.0))


def _bent(place: Tensor, error: Tensor) -> Tensor:
    """Errors (N, T, 3) of positions (T, 3) without the motion of the whole arm that is nearest to them.

    A ball in sockets does not show where the arm stands, nor does that matter to what is seen and touched in
    the arm's own frame.
    """
    turned = torch.linalg.cross(torch.eye(3, dtype=torch.float64)[:, None], place[None], dim=-1)
    shifted = torch.eye(3, dtype=torch.float64)[:, None].expand(3, len(place), 3)
    motions = torch.cat([shifted, turned]).flatten(1).T  # (3 T, 6)
    flat = error.flatten(1)
    moved = torch.linalg.lstsq(motions, flat.T, driver="gelsd").solution
    return (flat - (motions @ moved).T).unflatten(1, (-1, 3))


def corrected_joints(arm: Arm, draws: Trace, weights: Tensor) -> dict[str, Array]:
    """The joints' origins `parent_from_child` (4, 4) at the posterior mean, by name.

    An encoder's offset turns the joint's origin about its axis, and in proportion the origins of joints that
    mimic it. The fixed joint to the ball's link leads to where the ball is. Draws and their weights are those
    of `remaining_error`.
    """
    mean = {a: torch.einsum("n,n...->...", weights, draws[a]).numpy() for a in arm.spread}
    origins = {}
    for joint, k, factor, _ in driven_joints(arm.robot):
        matrix = joint.parent_from_child.copy()
        if "errors" in mean and joint is arm.robot.joints[k]:
            matrix[:3, 3] += mean["errors"][k, :3]
            matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_rotvec(mean["errors"][k, 3:]).as_matrix()
        offset = factor * mean["offsets"][k] * joint.axis
        if joint.kind == "prismatic":
            matrix[:3, 3] += matrix[:3, :3] @ offset
        else:
            matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_rotvec(offset).as_matrix()
        origins[joint.name] = matrix
    seat = arm.robot.joint_to(arm.link)
    matrix = seat.parent_from_child.copy()
    matrix[:3, 3] += matrix[:3, :3] @ mean["ball"]
    return {**origins, seat.name: matrix}


def laplace_proposal(
    arm: Arm, seatings: Sequence[Tensor], steps: int = 5
) -> Callable[[Arm, Sequence[Tensor]], None]:
    """A proposal of the latent values: the posterior of linearised kinematics.

    Kinematic errors of milliradians are nearly linear, so that importance sampling needs no moves.

    Args:
        arm: its prior.
        seatings: angles (T, J) of each.
        steps: of Gauss-Newton, each with the noise estimated from the residuals of the last one.

    Returns:
        A program `proposal(arm, seatings)` for `bcppl.inference.importance.importance_sampling`.
    """
    shapes = {address: spread.shape for address, spread in arm.spread.items()}
    prior = torch.cat([spread.reshape(-1) for spread in arm.spread.values()])
    unit = torch.eye(len(prior), dtype=torch.float64)

    def values(scaled: Tensor) -> dict[str, Tensor]:
        pieces = torch.split(scaled * prior, [shape.numel() for shape in shapes.values()], dim=1)
        return {a: piece.reshape(len(scaled), *shapes[a]) for a, piece in zip(shapes, pieces, strict=True)}

    def residuals(scaled: Tensor) -> Tensor:
        contrasts = [torch.from_numpy(helmert(len(q))) @ arm.positions(values(scaled), q) for q in seatings]
        return torch.cat([x.reshape(len(scaled), -1) for x in contrasts], dim=1)

    center, noise, step = torch.zeros_like(prior), arm.noise, 1e-3
    sides = torch.cat([unit, -unit])
    volume = sum(arm.log_volume(values(step * sides), q) for q in seatings)
    volume_gradient = torch.as_tensor(volume).unflatten(0, (2, -1)).diff(dim=0)[0] / (-2.0 * step)
    for _ in range(steps):
        residual = residuals(center[None])[0]
        jacobian = residuals(center + step * sides).unflatten(0, (2, -1)).diff(dim=0)[0].T / (-2.0 * step)
        gradient = jacobian.T @ (jacobian @ center - residual)
        information = jacobian.T @ jacobian
        precision = information / noise**2 + unit
        estimated = float(torch.trace(torch.linalg.solve(precision, information))) / noise**2
        center = torch.linalg.solve(precision, gradient / noise**2 + volume_gradient)
        freedom = len(residual) - estimated  # degrees of freedom of the residuals
        noise = float((residuals(center[None]).square().sum() / freedom).sqrt())

    def proposal(arm: Arm, seatings: Sequence[Tensor]) -> None:
        wider = dist.LogNormal(torch.tensor(np.log(noise)), 1.2 / np.sqrt(2.0 * freedom))
        scatter = pyro.sample("noise", wider)[:, None, None]
        covariance = torch.linalg.inv(information / scatter**2 + unit)
        factor = torch.linalg.cholesky(0.5 * (covariance + covariance.mT)) * prior[:, None]
        mean = prior * (covariance @ (gradient / scatter[..., 0] ** 2 + volume_gradient)[..., None])[..., 0]
        normals = mean.new_zeros(len(mean), 0)
        for address, shape in shapes.items():
            # Each address conditional on those before it: the standard normals through rows of the factor.
            rows = slice(normals.shape[1], normals.shape[1] + shape.numel())
            given = mean[:, rows] + (factor[:, rows, : rows.start] @ normals[..., None])[..., 0]
            square = factor[:, rows, rows]
            reshaped = dist.transforms.ReshapeTransform(torch.Size([shape.numel()]), shape)
            normal = dist.MultivariateNormal(given, scale_tril=square)
            value = pyro.sample(address, dist.TransformedDistribution(normal, reshaped))
            away = (value.reshape(given.shape) - given)[..., None]
            normals = torch.cat(
                [normals, torch.linalg.solve_triangular(square, away, upper=False)[..., 0]], 1
            )

    return proposal


def read_seatings(folder: str | Path) -> list[Tensor]:
    """The joint angles (T, J) of each seating in a folder: files `hole_0.csv`, `hole_1.csv`, one row a stamp.

    They come in the order of their numbers, `hole_10.csv` after `hole_9.csv`.

    Raises:
        InputError: there is no such file, or one holds anything but rows of numbers.
    """
    numbered = (
        (re.fullmatch(r"hole_(\d+)\.csv", file.name), file) for file in Path(folder).glob("hole_*.csv")
    )
    files = [file for _, file in sorted((int(found[1]), file) for found, file in numbered if found)]
    if not files:
        raise InputError(f"{folder} holds no hole_0.csv; give the folder of one tool position.")
    read = []
    for file in files:
        try:
            read.append(torch.from_numpy(np.loadtxt(file, delimiter=",", ndmin=2)))
        except (OSError, ValueError) as error:
            reason = reason_of(error)
            raise InputError(f"{file} must hold rows of joint angles ({reason}); record it again.") from error
        if not bool(torch.isfinite(read[-1]).all()):
            raise InputError(f"{file} holds an angle that is not finite; leave its row out.")
        if len(read[-1]) < 2:
            raise InputError(f"{file} holds {len(read[-1])} stamps; a seating needs at least two postures.")
    return read
