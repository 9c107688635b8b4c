"""Beliefs on disk: one small HDF5 file after each measurement of a run.

Beside the particles over the sought pose, the group `latent` holds their values at every latent address of
the model, (N, *event) each in the particles' order, so that one set of weights is for all:

    belief, values = load_belief(path), load_latent(path)
    share = belief.weights[values["which"] == 2].sum()  # probability of the third hole
    grip = Belief(values["grip_from_peg"], belief.log_weights)  # a pose: its mean, spread, modes

Every `load_*` raises InputError where there is no such file, or it holds no belief that this version reads.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import h5py
import torch
from torch import Tensor

from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.poses import Freedom
from bcppl.recordings.file import replacing

FORMAT = "bcppl belief"
SCHEMA_VERSION = 1
LATENT = "latent"
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
    with replacing(path) as beside, h5py.File(beside, "w") as file:
        file.attrs.update(format=FORMAT, schema_version=SCHEMA_VERSION, **attributes)
        file.attrs.update(free_translation=belief.freedom.translation, free_rotation=belief.freedom.rotation)
        poses = file.create_dataset("world_from_part", data=belief.world_from_part.numpy())
        poses.attrs["units"] = "m, unit quaternion: x y z qw qx qy qz"
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
        freedom = Freedom(str(file.attrs["free_translation"]), str(file.attrs["free_rotation"]))
        poses, log_weights = (torch.from_numpy(file[name][:]) for name in ("world_from_part", "log_weights"))
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
        return {str(site.attrs["address"]): torch.from_numpy(site[()]) for site in file[LATENT].values()}


def load_label(path: str | os.PathLike[str]) -> str:
    """The label of a belief that `save_belief` wrote: "prior", "view 1", "window 7"."""
    with _opened(path) as file:
        return str(file.attrs["label"])


def load_fingerprint(path: str | os.PathLike[str]) -> str:
    """The fingerprint of the recording that a belief is of; empty where `save_belief` was given none."""
    with _opened(path) as file:
        return str(file.attrs.get("of", ""))


def is_belief(path: str | os.PathLike[str]) -> bool:
    """Whether `save_belief`, of any version, wrote a file."""
    try:
        with h5py.File(path, "r") as file:
            return bool(file.attrs.get("format") == FORMAT)
    except OSError:
        return False


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no belief at {path}; `bcppl run` writes them into its --out folder.")
    try:
        with h5py.File(path) as file:
            if file.attrs.get("format") != FORMAT or int(file.attrs["schema_version"]) > SCHEMA_VERSION:
                raise InputError(f"{path} holds no belief that this version of bcppl reads; run it again.")
            yield file
    except (OSError, KeyError) as error:
        raise InputError(f"{path} is no whole belief file ({error}); run it again.") from error
