"""Generates `insert_trays.h5` from the published meshes: python -m bcppl.models.parts.build FOLDER."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from bcppl.geometry.layers import prismatic
from bcppl.geometry.parts import load_mesh
from bcppl.models.parts import SHAPES

SOURCE = (
    "IndustReal, from NVIDIA IsaacGymEnvs, BSD-3-Clause, copyright 2018-2023 NVIDIA Corporation; vertices "
    "merged, pegs moved, convex pieces by bcppl"
)


def build(folder: Path, path: Path) -> None:
    """Write the parts whose published OBJ files are in a folder."""
    with h5py.File(path, "w") as file:
        file.attrs["source"] = SOURCE
        for shape in SHAPES:
            for kind in ("tray", "peg"):
                stem = f"{'tray_insert_' if kind == 'tray' else ''}{shape}_peg_8mm"
                part = load_mesh(folder / f"industreal_{stem}.obj", f"{shape} insert {kind}")
                if kind == "peg":
                    top = np.array([0.0, 0.0, part.vertices[:, 2].max()])
                    part = replace(part, vertices=part.vertices - top)
                part = prismatic(part)
                group = file.create_group(f"{shape} {kind}")
                hulls = [piece.size for piece in part.pieces]
                stored = {
                    "vertices": np.round(part.vertices, 9),
                    "faces": part.faces.astype(np.int32),
                    "corners": np.concatenate(hulls),
                    "counts": np.array([len(hull) for hull in hulls]),
                }
                for name, array in stored.items():
                    group.create_dataset(name, data=array, compression="gzip", shuffle=True)


if __name__ == "__main__":
    build(Path(sys.argv[1]), Path(__file__).with_name("insert_trays.h5"))
