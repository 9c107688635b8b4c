"""An arm's kinematics are learnt from a ball that sits in sockets, wherever they are.

A ball on the flange is seated in a socket and the arm is moved through many postures in which the ball
stays where it is; the joint angles are recorded. By the nominal URDF the ball seems to wander by millimetres.
Latent are what the encoders read too little (`offsets`), where the ball is on its link (`ball`), how each
joint's origin differs from the drawing (`errors`), and how well the ball sits (`noise`). Where a socket
is need not be known: it is integrated out under a flat prior, so a turn of the whole arm about its base
keeps its prior.

What is measured are angles, so the density of the ball's place needs the volume sqrt(det J J^T) by which
angles become places. Without it a smaller arm, whose ball wanders less, would seem likelier: on real
recordings all distances came 0.1 mm too short. Idea and recordings: MUKCa, platonics-delft/
kinematics_calibration.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from scipy.linalg import helmert
from torch import Tensor

from bcppl.errors import InputError
from bcppl.robot.kinematics import Robot
from bcppl.traces import Trace


@dataclass(frozen=True, eq=False)
class Arm:
    """What is known beforehand of an arm and its ball.

    Attributes:
        robot: the nominal arm.
        link: whose origin is the ball's nominal centre.
        offset: standard deviation of the encoders' offsets, radians.
        shift, turn: standard deviations of the errors of the joints' origins, metres and radians; both 0
            takes the drawing for right, and there is no site `errors`.
        mount: standard deviation of the ball's centre about its nominal place, metres.
        noise: median of the scatter of a seated ball along each axis, metres; right within a factor of four.
    """

    robot: Robot
    link: str = "ball_link"
    offset: float = 0.01
    shift: float = 0.001
    turn: float = 0.005
    mount: float = 0.003
    noise: float = 0.0003

    @property
    def spread(self) -> Mapping[str, Tensor]:
        """Prior standard deviations of the latent values, all but the noise's."""
        joints = len(self.robot.joints)
        spread = {"offsets": torch.full((joints,), self.offset), "ball": torch.full((3,), self.mount)}
        if self.shift or self.turn:
            spread["errors"] = torch.tensor([self.shift] * 3 + [self.turn] * 3).expand(joints, 6)
        return {address: value.to(torch.float64) for address, value in spread.items()}

    def places(self, values: Mapping[str, Tensor], angles: Tensor) -> Tensor:
        """Where the ball is, (N, T, 3), by latent values and angles (T, J), metres."""
        offsets, ball = values["offsets"], values["ball"]
        return self.robot.position(self.link, angles, offsets, ball, values.get("errors"))

    def log_volume(self, values: Mapping[str, Tensor], angles: Tensor) -> Tensor:
        """Log of d(places) / d(angles), summed over the stamps, (N,).

        Raises:
            InputError: the angles are of another number of joints.
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
            places = self.places({**values, "offsets": moved}, angles)
            rows = [
                torch.autograd.grad(places[..., k].sum(), moved, create_graph=kept, retain_graph=True)[0]
                for k in range(3)
            ]
            slope = torch.stack(rows, dim=-2)  # (N, T, 3, J)
            return 0.5 * torch.logdet(slope @ slope.mT).sum(dim=1)


def arm_calibration(arm: Arm, seatings: Sequence[Tensor]) -> None:
    """The program: the arm as it is built, then for every seating how far the ball is from standing still."""
    values = {
        address: pyro.sample(address, dist.Normal(torch.zeros_like(spread), spread).to_event(spread.ndim))
        for address, spread in arm.spread.items()
    }
    noise = pyro.sample("noise", dist.LogNormal(torch.tensor(np.log(arm.noise)), 0.7))
    for k, angles in enumerate(seatings):
        # Orthonormal contrasts of the stamps: what is left of the data when their common mean is unknown.
        contrasts = torch.from_numpy(helmert(len(angles))) @ arm.places(values, angles)
        pyro.sample(f"seating_{k}", dist.Normal(contrasts, noise[:, None, None]).to_event(2))
        pyro.factor(f"volume_{k}", arm.log_volume(values, angles))


def observations(seatings: Sequence[Tensor]) -> Mapping[str, Tensor]:
    """A seated ball does not move: every contrast (T - 1, 3) is zero."""
    return {f"seating_{k}": torch.zeros(len(q) - 1, 3).double() for k, q in enumerate(seatings)}


def sockets(arm: Arm, trace: Trace, angles: Tensor) -> Tensor:
    """Draws (N, 3) of where a socket is, metres, from angles (T, J) of a ball seated in it."""
    mean = arm.places(trace.choices, angles).mean(dim=1)
    return mean + trace["noise"][:, None] / len(angles) ** 0.5 * torch.randn_like(mean)


def linearised(
    arm: Arm, seatings: Sequence[Tensor], rounds: int = 5
) -> Callable[[Arm, Sequence[Tensor]], None]:
    """A program that proposes the latent values: what the posterior would be, were the kinematics linear.

    Errors of milliradians are nearly linear, so that importance sampling with it needs no moves.

    Args:
        arm: what is known of the arm.
        seatings: angles (T, J) of each.
        rounds: Gauss-Newton steps, each with the noise that the residuals of the last one show.

    Returns:
        A program `proposal(arm, seatings)` for `bcppl.inference.importance.importance_sampling`.
    """
    shapes = {address: spread.shape for address, spread in arm.spread.items()}
    prior = torch.cat([spread.reshape(-1) for spread in arm.spread.values()])
    unit = torch.eye(len(prior), dtype=torch.float64)

    def values(scaled: Tensor) -> dict[str, Tensor]:
        pieces = torch.split(scaled * prior, [shape.numel() for shape in shapes.values()], dim=1)
        return {a: piece.reshape(len(scaled), *shapes[a]) for a, piece in zip(shapes, pieces, strict=True)}

    def wandering(scaled: Tensor) -> Tensor:
        found = [torch.from_numpy(helmert(len(q))) @ arm.places(values(scaled), q) for q in seatings]
        return torch.cat([x.reshape(len(scaled), -1) for x in found], dim=1)

    center, noise, step = torch.zeros_like(prior), arm.noise, 1e-3
    sides = torch.cat([unit, -unit])
    volume = sum(arm.log_volume(values(step * sides), q) for q in seatings)
    swell = torch.as_tensor(volume).unflatten(0, (2, -1)).diff(dim=0)[0] / (-2.0 * step)
    for _ in range(rounds):
        residual = wandering(center[None])[0]
        slope = wandering(center + step * sides).unflatten(0, (2, -1)).diff(dim=0)[0].T / (-2.0 * step)
        pull = slope.T @ (slope @ center - residual)
        information = slope.T @ slope
        precision = information / noise**2 + unit
        told = float(torch.trace(torch.linalg.solve(precision, information))) / noise**2
        center = torch.linalg.solve(precision, pull / noise**2 + swell)
        left = len(residual) - told
        noise = float((wandering(center[None]).square().sum() / left).sqrt())

    def proposal(arm: Arm, seatings: Sequence[Tensor]) -> None:
        loose = dist.LogNormal(torch.tensor(np.log(noise)), 1.2 / np.sqrt(2.0 * left))
        scatter = pyro.sample("noise", loose)[:, None, None]
        covariance = torch.linalg.inv(information / scatter**2 + unit)
        factor = torch.linalg.cholesky(0.5 * (covariance + covariance.mT)) * prior[:, None]
        mean = prior * (covariance @ (pull / scatter[..., 0] ** 2 + swell)[..., None])[..., 0]
        normals = mean.new_zeros(len(mean), 0)
        for address, shape in shapes.items():
            # Each address given those before it: the same standard normals through rows of the factor.
            rows = slice(normals.shape[1], normals.shape[1] + shape.numel())
            given = mean[:, rows] + (factor[:, rows, : rows.start] @ normals[..., None])[..., 0]
            square = factor[:, rows, rows]
            reshaped = dist.transforms.ReshapeTransform(torch.Size([shape.numel()]), shape)
            normal = dist.MultivariateNormal(given, scale_tril=square)
            chosen = pyro.sample(address, dist.TransformedDistribution(normal, reshaped))
            away = (chosen.reshape(given.shape) - given)[..., None]
            normals = torch.cat(
                [normals, torch.linalg.solve_triangular(square, away, upper=False)[..., 0]], 1
            )

    return proposal


def read_seatings(folder: str | Path) -> list[Tensor]:
    """The joint angles (T, J) of each seating in a folder: files `hole_0.csv`, `hole_1.csv`, one row a stamp.

    They come in the order of their numbers, `hole_10.csv` after `hole_9.csv`.

    Raises:
        InputError: there is no such file, or one holds something else than rows of numbers.
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
        except ValueError as error:
            raise InputError(f"{file} holds something else than rows of joint angles ({error}).") from error
        if len(read[-1]) < 2:
            raise InputError(f"{file} holds {len(read[-1])} stamps; a seating needs at least two postures.")
    return read
