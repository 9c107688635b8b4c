"""The signed distance to a part at the particles' poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.parameters import within

Distance = Callable[[Tensor], Any]
Scale = float | Tensor

LATENT_POSITIVE = within(above=0.0, latent=True)
OUTLIER = within(least=0.0, below=1.0)


class Placed:
    """A part at poses (N, 7): signed distances of places in the world, all expected ones in one call.

    A program that knows at which places its sites will be evaluated declares them with `expect`. The first
    evaluation then covers all of them: the paths of ten pushes take one call of the simulator, not twenty.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
    """

    __caches__ = ("_expected", "_known")

    def __init__(self, distance: Distance, pose: Tensor) -> None:
        self.distance, self.pose = distance, pose
        self._expected: list[Tensor] = []
        self._known: dict[tuple[int, torch.Size], tuple[Tensor, tuple[Tensor, Tensor]]] = {}

    def expect(self, places: Tensor) -> None:
        """Declare places (M, 3) in the world at which `near` will be called, with this same tensor."""
        self._expected.append(places)

    def near(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances (N, M) and outward normals (N, M, 3), in the world's axes, at places (M, 3)."""
        key = places.data_ptr(), places.shape
        if key not in self._known:
            batch = {(one.data_ptr(), one.shape): one for one in [*self._expected, places]}
            self._expected = []
            for (which, one), result in zip(batch.items(), self._evaluated([*batch.values()]), strict=True):
                self._known[which] = one, result  # kept, so that its memory is not used again
        return self._known[key][1]

    def _evaluated(self, places: list[Tensor]) -> list[tuple[Tensor, Tensor]]:
        turn = poses.rotation_matrix(self.pose)
        near = self.distance((torch.cat(places) - self.pose[:, None, :3]) @ turn)
        sizes = [len(one) for one in places]
        normal = near.normal @ turn.transpose(-1, -2)
        return list(zip(near.distance.split(sizes, dim=1), normal.split(sizes, dim=1), strict=True))


def distance_at(distance: Distance | Placed, pose: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance (N,) and outward normal (N, 3) in world axes at one place (3,), or (N, 3) of each."""
    if isinstance(distance, Placed):
        if places.ndim == 1:
            here, normal = distance.near(places[None])
            return here[:, 0], normal[:, 0]
        distance = distance.distance
    places = places.expand(len(pose), 3)
    near = distance(poses.transform(poses.inverse(pose), places[:, None])[:, 0])
    return near.distance, (poses.rotation_matrix(pose) @ near.normal[..., None])[..., 0]


def distance_along(distance: Distance | Placed, pose: Tensor, points: Tensor) -> Tensor:
    """Signed distances (N, R) of points (R, 3) in the world."""
    if isinstance(distance, Placed):
        return distance.near(points)[0]
    near: Tensor = distance(poses.transform(poses.inverse(pose), points)).distance
    return near
