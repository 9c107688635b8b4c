"""Beliefs on disk: one small HDF5 file after each measurement of a run."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import torch
from torch import Tensor

from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.poses import Freedom

FORMAT = "bcppl belief"
SCHEMA_VERSION = 1


def save_belief(
    belief: Belief, path: str | os.PathLike[str], *, label: str, log_evidence: float, random_state: Tensor
) -> None:
    """Write a belief, whole or not at all.

    Args:
        belief: the weighted particles.
        path: where to.
        label: the measurement after which it stands.
        log_evidence: of all measurements so far.
        random_state: torch's generator, so that a run can be gone on with.
    """
    path = Path(path)
    unfinished = path.with_name(path.name + ".part")
    try:
        with h5py.File(unfinished, "w") as file:
            file.attrs.update(
                format=FORMAT, schema_version=SCHEMA_VERSION, label=label, log_evidence=log_evidence
            )
            file.attrs.update(
                free_translation=belief.freedom.translation, free_rotation=belief.freedom.rotation
            )
            poses = file.create_dataset("world_from_part", data=belief.world_from_part.numpy())
            poses.attrs["units"] = "m, unit quaternion: x y z qw qx qy qz"
            file.create_dataset("log_weights", data=belief.log_weights.numpy())
            file.create_dataset("random_state", data=random_state.numpy())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def load_belief(path: str | os.PathLike[str]) -> Belief:
    """Read a belief that `save_belief` wrote.

    Raises:
        InputError: there is no such file, or it holds no belief that this version reads.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no belief at {path}; `bcppl run` writes them into its --out folder.")
    try:
        with h5py.File(path) as file:
            if file.attrs.get("format") != FORMAT or int(file.attrs["schema_version"]) > SCHEMA_VERSION:
                raise InputError(f"{path} holds no belief that this version of bcppl reads; run it again.")
            freedom = Freedom(str(file.attrs["free_translation"]), str(file.attrs["free_rotation"]))
            poses, log_weights = (
                torch.from_numpy(file["world_from_part"][:]),
                torch.from_numpy(file["log_weights"][:]),
            )
    except (OSError, KeyError) as error:
        raise InputError(f"{path} is no whole belief file ({error}); run it again.") from error
    return Belief(poses, log_weights, freedom)
