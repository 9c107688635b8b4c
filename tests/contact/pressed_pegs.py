"""Pegs that are pressed somewhere, and their wrenches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
import trimesh
from scipy.spatial.transform import Rotation

from bcppl.contact.sensing.load import ToolLoad
from bcppl.contact.sensing.noise import WrenchNoise
from bcppl.geometry.extrusion import box_peg
from bcppl.geometry.parts import Part

LOGS = Path(__file__).parents[3] / "shared/data/point_probe_pushes"
PEG = box_peg(0.016, 0.05)
COVARIANCE = WrenchNoise().covariance(0.1)
LOAD = ToolLoad(0.8, (0.01, -0.02, -0.05))


def wrench(point: np.ndarray, force: np.ndarray) -> np.ndarray:
    return np.concatenate([force, np.cross(point, force)], axis=-1)


def noisy(values: np.ndarray, rng: np.random.Generator, covariance: np.ndarray = COVARIANCE) -> np.ndarray:
    return np.asarray(values + rng.normal(size=values.shape) * np.sqrt(np.diag(covariance)))


def orientations(count: int, rng: np.random.Generator) -> np.ndarray:
    """Poses (count, 7) at the origin, turned anyhow."""
    turn = Rotation.random(count, rng=rng).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([np.zeros((count, 3)), turn], axis=1)


def fork() -> Part:
    """Two prongs side by side along x, 12 mm apart."""
    outline = shapely.difference(
        shapely.box(-0.012, -0.008, 0.012, 0.008), shapely.box(-0.006, -0.004, 0.006, 0.009)
    )
    mesh = trimesh.creation.extrude_polygon(outline, 0.05)
    return Part("fork", np.asarray(mesh.vertices) - [0, 0, 0.05], np.asarray(mesh.faces, dtype=np.int64))


def pressed(peg: Part, count: int, seed: int, friction: float = 0.5) -> tuple[np.ndarray, ...]:
    """Points (count, 3) all over a peg, normals, and wrenches of 3 to 15 N evenly within the cone."""
    rng = np.random.default_rng(seed)
    points, faces = trimesh.sample.sample_surface(peg.mesh, count, seed=seed)
    normals = np.asarray(peg.mesh.face_normals[faces])
    up = rng.uniform(1.0 / np.hypot(1.0, friction), 1.0, (count, 1))
    side = np.cross(normals, rng.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    force = rng.uniform(3.0, 15.0, (count, 1)) * (np.sqrt(1.0 - up**2) * side - up * normals)
    return np.asarray(points), normals, wrench(np.asarray(points), force)
