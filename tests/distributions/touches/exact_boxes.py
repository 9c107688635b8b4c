"""Signed distances to boxes in closed form, for likelihoods that evaluate them at millions of points."""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.geometry.distance import Proximity


class Boxes:
    """Axis-aligned boxes of half sizes `half` (3,) about centres (B, 3), with `SignedDistance`'s call."""

    def __init__(self, half: tuple[float, float, float], *centers: tuple[float, float, float]) -> None:
        self.half = torch.tensor(half, dtype=torch.float64)
        self.centers = torch.tensor(centers or [(0.0, 0.0, 0.0)], dtype=torch.float64)

    def __call__(self, points: Tensor) -> Proximity:
        distances, normals = zip(*(self._to_one(points - center) for center in self.centers), strict=True)
        nearest = torch.stack(distances).argmin(dim=0, keepdim=True)
        distance = torch.stack(distances).gather(0, nearest)[0]
        normal = torch.stack(normals).gather(0, nearest[..., None].expand(*nearest.shape, 3))[0]
        return Proximity(distance, points - distance[..., None] * normal, normal)

    def _to_one(self, points: Tensor) -> tuple[Tensor, Tensor]:
        beyond = points.abs() - self.half
        outside = beyond.clamp(min=0.0)
        length = outside.norm(dim=-1)
        face = torch.nn.functional.one_hot(beyond.argmax(dim=-1), 3).to(torch.float64)
        direction = torch.where(length[..., None] > 1e-9, outside / length.clamp(min=1e-12)[..., None], face)
        sign = torch.where(points < 0.0, -1.0, 1.0).to(torch.float64)
        return length + beyond.amax(dim=-1).clamp(max=0.0), sign * direction
