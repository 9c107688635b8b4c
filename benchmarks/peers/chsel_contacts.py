"""CHSEL: poses of a part from contacts, planar, from poses drawn from the prior.

Reads a file of `real.py`: the part's mesh, contacts of several draws, the part's signed distance at a
contact, and the poses that each draw starts from. Prints the poses that come back, their costs and the
seconds of each draw; the first draw is run once before, not counted. Works in metres; 15 iterations,
everything else as CHSEL's constructor sets it but for the cost class: the default carries voxels of free
space to the part at every iteration, and there are none here.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from importlib.metadata import version
from pathlib import Path

import chsel
import numpy as np
import open3d as o3d
import pytorch_volumetric as pv
import torch
from chsel.costs import VolumetricDoubleDirectCost
from chsel.measure import SE2PositionMeasure

ITERATIONS = 15
UP = torch.tensor([0.0, 0.0, 1.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="an .npz that real.py has written")
    parser.add_argument("--measure", choices=["yaw", "position"], default="yaw", help="of diversity")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    torch.set_num_threads(arguments.threads)
    given = np.load(arguments.file)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(given["vertices"]), o3d.utility.Vector3iVector(given["faces"])
    )
    distance = pv.MeshSDF(pv.MeshObjectFactory(mesh=mesh))
    settings = {"axis_of_rotation": UP, "offset_along_axis": 0}
    if arguments.measure == "position":
        settings["qd_measure"] = SE2PositionMeasure(**settings)

    def found(k: int) -> dict[str, object]:
        np.random.seed(k)
        torch.manual_seed(k)
        contacts = torch.tensor(given["contacts"][k], dtype=torch.float)
        part_from_world = torch.tensor(np.linalg.inv(given["starts"][k]), dtype=torch.float)
        begun = time.perf_counter()
        registration = chsel.CHSEL(
            distance,
            contacts,
            torch.full((len(contacts),), chsel.SemanticsClass.SURFACE.value),
            known_sdf_values=torch.full((len(contacts),), float(given["signed_distance"][k])),
            cost=VolumetricDoubleDirectCost,
            scale_known_freespace=0,
            **settings,
        )
        result, _ = registration.register(
            iterations=ITERATIONS, batch=len(part_from_world), initial_tsf=part_from_world
        )
        seconds = time.perf_counter() - begun
        poses = chsel.solution_to_world_to_link_matrix(result).inverse().double()
        return {
            "world_from_part": poses.tolist(),
            "cost": result.rmse.double().tolist(),
            "seconds": seconds,
            "version": version("chsel"),
        }

    found(0)
    for k in range(len(given["contacts"])):
        print(json.dumps(found(k)), flush=True)


if __name__ == "__main__":
    main()
