"""Open3D: depth images of a mesh at many poses by `RaycastingScene`, from poses to arrays.

Reads a file of `render.py`: vertices, faces, poses in the camera's frame, the image's size and its rays.
Prints seconds of every pass; the rays are turned into the part's frame in numpy, a million at a time.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import open3d as o3d

MANY = 1 << 20  # rays


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="an .npz that render.py has written")
    parser.add_argument("--repeats", type=int, default=5, help="after one that is not counted")
    parser.add_argument("--threads", type=int, default=0, help="0: as many as Open3D likes")
    arguments = parser.parse_args()
    given = np.load(arguments.file)
    rotation, offset, rays = given["rotation"], given["offset"], given["rays"]
    shape = (len(rotation), int(given["height"]), int(given["width"]))
    scene = o3d.t.geometry.RaycastingScene(nthreads=arguments.threads)
    scene.add_triangles(given["vertices"].astype(np.float32), given["faces"].astype(np.uint32))

    def images() -> np.ndarray:
        found = np.empty(shape, np.float32)
        step = max(1, MANY // len(rays))
        for first in range(0, len(rotation), step):
            turn, there = rotation[first : first + step], offset[first : first + step]
            line = np.empty((len(turn), len(rays), 6), np.float32)
            line[..., :3] = -np.einsum("nji,nj->ni", turn, there).astype(np.float32)[:, None]
            line[..., 3:] = rays @ turn.astype(np.float32)
            cast = scene.cast_rays(o3d.core.Tensor(line), nthreads=arguments.threads)
            found[first : first + step] = cast["t_hit"].numpy().reshape(-1, *shape[1:])
        return found

    seconds = []
    for _ in range(arguments.repeats + 1):
        begun = time.perf_counter()
        images()
        seconds.append(time.perf_counter() - begun)
    print(json.dumps({"seconds": seconds[1:], "version": o3d.__version__}))


if __name__ == "__main__":
    main()
