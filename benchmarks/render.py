"""Depth images a second, from poses to arrays, beside other renderers in the same run.

75 poses of an annulus at 0.15 m and of the YCB power drill at 0.5 m, at 128x128, 160x120 and 640x480. Passes
of all renderers alternate, so that a machine that slows down slows all of them; MuJoCo and Open3D run in
processes of their own, two passes at a time. Rays are built and cast a million at a time: all at once they
would need gigabytes. Depth is compared with trimesh's.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import peer
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from report import DATA, Row, cores, finish, options, show
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.rasterisation import Rasteriser, renderer_for
from bcppl.rendering.ray_casting import RayCaster

SIZES = ((128, 128), (160, 120), (640, 480))
DRILL = DATA / "ycb_power_drill" / "textured_simple_reoriented.obj"
POSES = 75
EDGE = 1e-3  # m: beside a pixel whose neighbours step by more, two renderers may differ
CLOSE = 1e-5  # m
RAYS = 1 << 14  # in one call of Embree, as many as stay in the cache
MANY = 1 << 20  # rays that are built at a time
FAR = 1e30  # m: Embree returns 1e37 for a ray that hits nothing


class Scene(NamedTuple):
    """A mesh at poses before a camera.

    Attributes:
        name: of the mesh.
        part: the mesh.
        rotation, offset: `camera_from_part`, (N, 3, 3) and (N, 3).
        camera: at the origin.
    """

    name: str
    part: Part
    rotation: Array
    offset: Array
    camera: Camera

    @property
    def poses(self) -> Array:
        """The part's poses (N, 7)."""
        turn = Rotation.from_matrix(self.rotation).as_quat()[:, [3, 0, 1, 2]]
        return np.concatenate([self.offset, turn], axis=1)


def scene(name: str, mesh: trimesh.Trimesh, size: tuple[int, int], seed: int) -> Scene:
    """The mesh about where the camera looks: the annulus at 0.15 m, anything else at 0.5 m."""
    distance, shift, turn = (0.15, 0.005, 0.2) if name == "annulus" else (0.5, 0.01, 0.5)
    generator = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(generator.normal(size=(POSES, 3)) * turn).as_matrix()
    offset = np.array([0.0, 0.0, distance]) + generator.normal(size=(POSES, 3)) * shift
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    width, height = size
    middle = np.array([0, 0, 0, 1.0, 0, 0, 0])
    camera = Camera(name, width, height, 1.2 * width, 1.2 * width, (width - 1) / 2, (height - 1) / 2, middle)
    return Scene(name, Part(name, vertices, np.asarray(mesh.faces, dtype=np.int64)), rotation, offset, camera)


def rays_of(scene: Scene, some: slice) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Origins and directions (n * H * W, 3) of all rays of some images, in the part's frame."""
    rays = scene.camera.rays().astype(np.float32)
    directions = rays @ scene.rotation[some].astype(np.float32)
    origins = -np.einsum("nji,nj->ni", scene.rotation[some], scene.offset[some]).astype(np.float32)
    return np.repeat(origins, len(rays), axis=0), directions.reshape(-1, 3)


def in_turn(scene: Scene, cast: Callable[..., npt.NDArray[np.floating]]) -> npt.NDArray[np.floating]:
    """Images (N, H, W) by `cast(origins, directions)`, which gives depths, some images at a time."""
    height, width = scene.camera.height, scene.camera.width
    step = max(1, MANY // (height * width))
    images = np.empty((POSES, height, width), np.float32)
    for first in range(0, POSES, step):
        some = slice(first, first + step)
        images[some] = cast(*rays_of(scene, some)).reshape(-1, height, width)
    return images


def embree(scene: Scene) -> EmbreeScene:
    """The mesh as Embree has it."""
    tree = EmbreeScene(robust=True)
    TriangleMesh(tree, scene.part.vertices[scene.part.faces].astype(np.float32))
    return tree


def by_trimesh(scene: Scene) -> npt.NDArray[np.floating]:
    """Images by trimesh's `intersects_location`."""

    def cast(origins: Array, directions: Array) -> Array:
        points, ray, _ = scene.part.mesh.ray.intersects_location(origins, directions, multiple_hits=False)
        depth = np.full(len(origins), np.inf)
        reach = np.linalg.norm(directions[ray], axis=1)
        depth[ray] = np.linalg.norm(points - origins[ray], axis=1) / reach
        return depth

    return in_turn(scene, cast)


def here(scene: Scene) -> dict[str, Callable[[], object]]:
    """What runs in this process."""
    poses, tree, camera = scene.poses, embree(scene), scene.camera
    chosen, cast = renderer_for(scene.part), RayCaster(scene.part)
    one_thread = Rasteriser(scene.part, threads=1)
    drawn = chosen.images(camera, poses)
    hit = np.isfinite(drawn.reshape(POSES, -1))
    each = [rays_of(scene, slice(k, k + 1)) for k in range(POSES)]
    origins, directions = (
        np.concatenate([r[which][h] for r, h in zip(each, hit, strict=True)]) for which in (0, 1)
    )
    del each

    def ready() -> None:
        for first in range(0, len(origins), RAYS):
            tree.run(origins[first : first + RAYS], directions[first : first + RAYS], query="DISTANCE")

    def cast_direct(origins: Array, directions: Array) -> npt.NDArray[np.floating]:
        depth = tree.run(origins, directions, query="DISTANCE")
        depth[depth > FAR] = np.inf
        return depth

    return {
        "bcppl": lambda: chosen.images(camera, poses),
        "bcppl, hits": lambda: chosen.hits(camera, poses),
        "bcppl, one thread": lambda: one_thread.images(camera, poses),
        "bcppl, rays": lambda: cast.images(camera, poses),
        "embreex, rays ready": ready,
        "embreex": lambda: in_turn(scene, cast_direct),
        "trimesh": lambda: by_trimesh(scene),
    }


def elsewhere(file: Path, repeats: int) -> dict[str, tuple[list[float], str]]:
    """Seconds of every pass of those that run in processes of their own, and why others are absent."""
    found: dict[str, tuple[list[float], str]] = {}
    for back_end in ("egl", "osmesa"):
        command = [
            sys.executable,
            str(peer.SCRIPTS / "mujoco_depth.py"),
            str(file),
            "--repeats",
            str(repeats),
        ]
        variables = {**os.environ, "MUJOCO_GL": back_end}
        done = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
        name = f"MuJoCo, {back_end}"
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1]
            library = "libegl1" if back_end == "egl" else "libosmesa6"
            found[name] = (
                [],
                f"{name} is left out ({last}); install the system's library, {library} on Debian.",
            )
        else:
            found[name] = json.loads(done.stdout.splitlines()[-1])["seconds"], ""
    answered = peer.ask("open3d", "open3d_depth.py", file, "--repeats", repeats)
    if answered:
        found["Open3D"] = answered[-1]["seconds"], ""
    return found


def measure(scene: Scene, rounds: int, folder: Path) -> dict[str, list[float]]:
    """Seconds of every pass, round by round."""
    file = folder / f"{scene.name}_{scene.camera.width}.npz"
    np.savez(
        file,
        vertices=scene.part.vertices,
        faces=scene.part.faces,
        rotation=scene.rotation,
        offset=scene.offset,
        rays=scene.camera.rays().astype(np.float32),
        width=scene.camera.width,
        height=scene.camera.height,
        focal=scene.camera.fx,
    )
    seconds: dict[str, list[float]] = {}
    engines = here(scene)
    reported: set[str] = set()
    for turn in range(rounds + 1):
        for name, run in engines.items():
            begun = time.perf_counter()
            run()
            if turn:  # the first warms up
                seconds.setdefault(name, []).append(time.perf_counter() - begun)
        if turn:
            for name, (passes, why) in elsewhere(file, 2).items():
                if why and why not in reported:
                    reported.add(why)
                    print(why)
                if passes:
                    seconds.setdefault(name, []).extend(passes)
    return seconds


def edges(depth: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Pixels whose neighbourhood of 3 x 3 has a step, or is bent, by more than 1 mm."""
    finite = np.pad(np.where(np.isfinite(depth), depth, 10.0), ((0, 0), (1, 1), (1, 1)), mode="edge")
    height, width = depth.shape[1:]
    around = [finite[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
    bent = [np.abs(around[k] + around[8 - k] - 2.0 * around[4]) for k in range(4)]
    return np.asarray(np.maximum.reduce(bent) > EDGE)


def accuracy(scene: Scene) -> dict[str, float]:
    """How the depth of bcppl differs from trimesh's."""
    own, other = renderer_for(scene.part).images(scene.camera, scene.poses), by_trimesh(scene)
    with np.errstate(invalid="ignore"):
        difference = np.abs(own - other)
    difference[np.isinf(own) & np.isinf(other)] = 0.0
    seen, differ = np.isfinite(other) | np.isfinite(own), difference > CLOSE
    away = differ & ~edges(other)
    return {
        "differ": float(differ.sum() / seen.sum()),
        "away": float(away.sum()),
        "largest": float(difference[seen & ~differ].max()),
        "seen": float(seen.sum()),
    }


def main() -> None:
    parser = options(__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=7, help="passes of each renderer; two a round of some")
    arguments = parser.parse_args()
    meshes = {"annulus": trimesh.creation.annulus(r_min=0.01, r_max=0.03, height=0.03, sections=64)}
    if DRILL.is_file():
        meshes["drill"] = trimesh.load(DRILL, force="mesh", process=True)
    else:
        print(f"the drill is left out: {DRILL} is absent.")
    rows, lines, compared = [], [], []
    for name, mesh in meshes.items():
        for size in SIZES[:2] if arguments.quick else SIZES:
            here_and_there = scene(name, mesh, size, arguments.seed)
            with tempfile.TemporaryDirectory() as folder:
                seconds = measure(here_and_there, 1 if arguments.quick else arguments.rounds, Path(folder))
            row = f"{name} {size[0]}x{size[1]}"
            time_of = {peer_name: statistics.median(each) for peer_name, each in seconds.items()}
            for peer_name, each in seconds.items():
                rate = POSES / time_of[peer_name]
                spread = [f"{POSES / max(each):.0f}", f"{POSES / min(each):.0f}"]
                ratio = f"{time_of[peer_name] / time_of['bcppl']:.2f}"
                lines.append([row, peer_name, f"{rate:.0f}", *spread, len(each), ratio])
                rows.append(Row(f"{peer_name}, {row}", rate, "images/s"))
                if not peer_name.startswith("bcppl") and peer_name != "embreex, rays ready":
                    goal = 3.0 if (name, peer_name) == ("annulus", "Open3D") else 1.0
                    rows.append(
                        Row(
                            f"bcppl / {peer_name}, {row}",
                            rate_ratio(time_of, peer_name),
                            "ratio",
                            goal,
                            "min",
                        )
                    )
            for own in ("bcppl", "bcppl, hits"):
                ready = time_of[own] / time_of["embreex, rays ready"]
                rows.append(Row(f"{own} / embreex with rays ready, {row}", ready, "ratio of times", 1.25))
            found = accuracy(here_and_there)
            counts = [f"{found['seen']:.0f}", f"{100 * found['differ']:.4f}", int(found["away"])]
            compared.append([row, *counts, f"{found['largest']:.1e}"])
            rows.append(Row(f"pixels that differ by 1e-5 m, {row}", 100 * found["differ"], "% of those seen"))
            rows.append(Row(f"of them away from edges, {row}", found["away"], "pixels", 0.0))
    show(
        f"{POSES} depth images a call, from poses to arrays, images a second, {cores()} cores",
        ["", "", "median", "least", "most", "passes", "time / bcppl's"],
        lines,
    )
    show(
        "depth beside trimesh's",
        ["", "pixels seen", "% differ by > 1e-5 m", "of them away from edges", "largest other difference, m"],
        compared,
    )
    finish(rows, arguments.json)


def rate_ratio(time_of: dict[str, float], other: str) -> float:
    """Images a second of bcppl over those of another."""
    return time_of[other] / time_of["bcppl"]


if __name__ == "__main__":
    main()
