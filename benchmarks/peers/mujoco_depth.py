"""MuJoCo's own renderer: depth images of a mesh at many poses, from poses to arrays.

Reads a file of `render.py`; `MUJOCO_GL` says which GL draws, egl or osmesa. Prints seconds of every pass.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

FLIP = np.diag([1.0, -1.0, -1.0])  # from the optical frame (y down, z forward) to MuJoCo's (y up, z backward)


def model_of(given: dict[str, np.ndarray]) -> mujoco.MjModel:
    """The mesh as a mocap body before a camera at the origin."""
    width, height, focal = int(given["width"]), int(given["height"]), float(given["focal"])
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 10
    spec.stat.extent, spec.stat.center = 1.0, [0, 0, 0]
    vertices, faces = given["vertices"], given["faces"]
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(
        name="mesh", uservert=vertices.ravel(), userface=faces.astype(np.int32).ravel(), inertia=shell
    )
    body = spec.worldbody.add_body(name="part", mocap=True)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", contype=0, conaffinity=0)
    spec.worldbody.add_camera(name="camera", fovy=2 * np.degrees(np.arctan(height / 2 / focal)))
    return spec.compile()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="an .npz that render.py has written")
    parser.add_argument("--repeats", type=int, default=5, help="after one that is not counted")
    arguments = parser.parse_args()
    given = dict(np.load(arguments.file))
    model = model_of(given)
    data = mujoco.MjData(model)
    quaternion = Rotation.from_matrix(FLIP @ given["rotation"]).as_quat()[:, [3, 0, 1, 2]]
    position = given["offset"] @ FLIP.T
    # In a `with` block: closed by the garbage collector, the renderer raises on OSMesa.
    with mujoco.Renderer(model, int(given["height"]), int(given["width"])) as renderer:
        renderer.enable_depth_rendering()

        def images() -> np.ndarray:
            found = np.empty((len(position), int(given["height"]), int(given["width"])), np.float32)
            for k in range(len(position)):
                data.mocap_pos[0], data.mocap_quat[0] = position[k], quaternion[k]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                renderer.update_scene(data, "camera")
                renderer.render(out=found[k])
            return found

        seconds = []
        for _ in range(arguments.repeats + 1):
            begun = time.perf_counter()
            images()
            seconds.append(time.perf_counter() - begun)
    print(json.dumps({"seconds": seconds[1:], "version": mujoco.__version__}))


if __name__ == "__main__":
    main()
