"""Beliefs on disk: one small HDF5 file after each measurement of a run.

Beside the particles over the sought pose, the group `latent` holds their values at every latent address of
the model, (N, *event) each in the particles' order, so that one set of weights is for all:

    belief, values = load_belief(path), load_latent(path)
    share = belief.weights[values["which"] == 2].sum()  # probability of the third hole
    grip = Belief(values["grip_from_peg"], belief.log_weights)  # a pose: its mean, spread, modes

Every `load_*` raises InputError where there is no such file, or it holds no belief that this version reads.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import h5py
import numpy as np
import torch
from torch import Tensor

from bcppl.arguments import pose_problem
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.poses import Freedom
from bcppl.recordings.hdf5 import created, opened
from bcppl.sensors.layout import text

FORMAT = "bcppl belief"
SCHEMA_VERSION = 1
LATENT = "latent"
UNITS = "m, unit quaternion: x y z qw qx qy qz"
SAFE = " !#$&'()*+,:;=?@[]"  # left as they are in an address; a slash is not


def save_belief(
    belief: Belief,
    path: str | os.PathLike[str],
    *,
    label: str,
    log_evidence: float,
    random_state: Tensor,
    latent: Mapping[str, Tensor] | None = None,
    of: str = "",
) -> None:
    """Write a belief, whole or not at all.

    Args:
        belief: the weighted particles.
        path: where to.
        label: of the last measurement that it has assimilated.
        log_evidence: of all measurements so far.
        random_state: of torch's generator after the step; a run is resumed from a step, not from a belief
            (`bcppl.inference.saved.save_step`).
        latent: values (N, *event) at the latent addresses.
        of: the `bcppl.recordings.fingerprint.fingerprint` of the recording's assimilated measurements.

    Raises:
        InputError: the file cannot be written.
    """
    attributes = {"label": label, "log_evidence": log_evidence, "of": of}
    with created(path) as file:
        file.attrs.update(format=FORMAT, schema_version=SCHEMA_VERSION, **attributes)
        file.attrs.update(free_translation=belief.freedom.translation, free_rotation=belief.freedom.rotation)
        poses = file.create_dataset("world_from_part", data=belief.world_from_part.numpy())
        poses.attrs["units"] = UNITS
        file.create_dataset("log_weights", data=belief.log_weights.numpy())
        file.create_dataset("random_state", data=random_state.numpy())
        group = file.create_group(LATENT)
        for address, values in (latent or {}).items():
            # A slash would make groups of groups, and "a" could not stand beside "a/b".
            site = group.create_dataset(quote(address, safe=SAFE), data=values.detach().numpy())
            site.attrs["address"] = address


def load_belief(path: str | os.PathLike[str]) -> Belief:
    """The belief in a file that `save_belief` wrote."""
    with _opened(path) as file:
        freedom = Freedom(text(file.attrs["free_translation"]), text(file.attrs["free_rotation"]))
        poses, log_weights = (_numbers(file[name]) for name in ("world_from_part", "log_weights"))
        if file["world_from_part"].attrs["units"] != UNITS:
            raise InputError(f"world_from_part is in other units than {UNITS!r}; run it again.")
        if log_weights.ndim != 1 or len(poses) != len(log_weights) or not len(poses):
            shapes = f"{tuple(poses.shape)} poses and {tuple(log_weights.shape)} log weights"
            raise InputError(f"the belief has {shapes}; run it again.")
        if problem := pose_problem("world_from_part", poses.numpy()):
            raise InputError(problem)
        if bool((log_weights.isnan() | (log_weights == torch.inf)).any()):
            raise InputError("a log weight is NaN or infinite; run it again.")
    return Belief(poses, log_weights, freedom)


def load_latent(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """The particles' values at the model's latent addresses, in a file that `save_belief` wrote.

    Returns:
        Values (N, *event) by address, in the particles' order, weighted by `load_belief(path).weights`.

    Raises:
        InputError: as the others here, or the file is of a version of bcppl that kept the pose alone.
    """
    with _opened(path) as file:
        if LATENT not in file:
            raise InputError(f"{path} holds the pose alone, as earlier versions of bcppl did; run it again.")
        held = {text(site.attrs["address"]): _numbers(site) for site in file[LATENT].values()}
        count = len(file["log_weights"])
        for address, values in held.items():
            if not values.ndim or len(values) != count:
                shape = tuple(values.shape)
                raise InputError(
                    f"the values at {address!r} are of shape {shape}, not ({count}, ...); run it again."
                )
        return held


def _numbers(kept: h5py.Dataset) -> Tensor:
    """The numbers of a dataset.

    Raises:
        TypeError: it holds something else.
    """
    return torch.from_numpy(np.asarray(kept[()]))


def load_label(path: str | os.PathLike[str]) -> str:
    """The label of a belief that `save_belief` wrote: "prior", "view 1", "window 7"."""
    with _opened(path) as file:
        return text(file.attrs["label"])


def load_fingerprint(path: str | os.PathLike[str]) -> str:
    """The fingerprint of the recording that a belief is of; empty where `save_belief` was given none."""
    with _opened(path) as file:
        return text(file.attrs.get("of", ""))


def is_belief(path: str | os.PathLike[str]) -> bool:
    """Whether `save_belief`, of any version, wrote a file."""
    try:
        with opened(path) as file:
            return bool(file.attrs.get("format") == FORMAT)
    except InputError:
        return False


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no belief at {path}; `bcppl run` writes them into its --out folder.")
    with opened(path, "run it again") as file:
        known = file.attrs.get("format") == FORMAT
        if not known or not 1 <= operator.index(file.attrs["schema_version"]) <= SCHEMA_VERSION:
            raise InputError(f"{path} holds no belief that this version of bcppl reads; run it again.")
        yield file
