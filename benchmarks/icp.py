"""Registration by nearest points, point to plane: what others would do with depth images and masks of an arm.

Chen and Medioni, Object modelling by registration of multiple range images, Image and Vision Computing 10,
1992. Points on the meshes that face the camera are matched; all views have one camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses

SAMPLED = 30_000  # points on each mesh
KEPT = 6_000  # pixels of each view
ROUNDS = 40


def nearest_points(
    meshes: Sequence[trimesh.Trimesh],
    clouds: Sequence[npt.NDArray[np.float64]],
    base_from_camera: Tensor,
    reach: float,
) -> Tensor:
    """The camera's pose (7,) that brings points onto meshes.

    Args:
        meshes: what each view shows, in the base's frame, metres.
        clouds: (P, 3) points of each view in the camera's frame.
        base_from_camera: (7,) where to start.
        reach: points farther than this from a mesh do not count, metres.
    """
    generator = np.random.default_rng(0)
    drawn = [trimesh.sample.sample_surface(mesh, SAMPLED, seed=0) for mesh in meshes]
    faces = [(points, mesh.face_normals[face]) for mesh, (points, face) in zip(meshes, drawn, strict=True)]
    seen = [cloud[generator.choice(len(cloud), min(KEPT, len(cloud)), replace=False)] for cloud in clouds]
    turn, place = poses.rotation_matrix(base_from_camera).numpy(), base_from_camera[:3].numpy()
    for _ in range(ROUNDS):
        information, pull = np.zeros((6, 6)), np.zeros(6)
        for (points, normals), cloud in zip(faces, seen, strict=True):
            facing = np.einsum("ij,ij->i", points - place, normals) < 0.0
            turned = cloud @ turn.T
            away, nearest = cKDTree(points[facing]).query(turned + place, distance_upper_bound=reach)
            found = np.isfinite(away)
            normal = normals[facing][nearest[found]]
            gap = np.einsum("ij,ij->i", points[facing][nearest[found]] - turned[found] - place, normal)
            rows = np.concatenate([normal, np.cross(turned[found], normal)], axis=1)
            information += rows.T @ rows
            pull += rows.T @ gap
        step = np.linalg.solve(information, pull)
        turn, place = Rotation.from_rotvec(step[3:]).as_matrix() @ turn, place + step[:3]
        if np.abs(step).max() < 1e-5:
            break
    return poses.from_rotation_matrix(torch.from_numpy(place), torch.from_numpy(turn))
