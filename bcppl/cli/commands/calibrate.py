"""`bcppl calibrate arm`: an arm's kinematics from a ball in sockets, as a URDF and a profile of the bench."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

calibrate_app = typer.Typer(help="Calibrate a bench.", no_args_is_help=True)

SEATED = 6  # seatings, below which a calibration is warned of


@calibrate_app.callback()
def _kinds() -> None: ...  # with one command alone, typer would leave out its name


@calibrate_app.command("arm")
def arm(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Joint angles, a row a stamp in radians, of a ball on the flange that is seated in sockets: "
            "files hole_0.csv, hole_1.csv, or folders of such files, one for each place of the sockets."
        ),
    ],
    urdf: Annotated[Path, typer.Option(dir_okay=False, help="The nominal arm, with a link at the ball.")],
    link: Annotated[str, typer.Option(help="The link whose origin is the ball's centre.")] = "ball_link",
    profile: Annotated[str, typer.Option(help="The bench's profile in all but its kinematics.")] = "panda",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Files to write: this with .urdf, and with .json.")
    ] = Path("calibrated"),
    particles: Annotated[int, typer.Option(min=50, help="Draws of the posterior.")] = 300,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Same seed, same files.")] = 0,
) -> None:
    """Write the calibrated arm as a URDF, and how sure of it one may be as a profile (--set profile=FILE)."""
    import torch
    from rich.console import Console

    from bcppl.beliefs import normalised
    from bcppl.inference.importance import importance_sampling
    from bcppl.models.arm_calibration import (
        Arm,
        arm_calibration,
        corrected_joints,
        laplace_proposal,
        observations,
        remaining_error,
        require_sockets,
    )
    from bcppl.recordings.hdf5 import replacing
    from bcppl.robot.correction import corrected
    from bcppl.robot.kinematics import Robot
    from bcppl.sensors.likelihoods.bench_profiles import profile_tree

    files = [out.with_suffix(suffix) for suffix in (".urdf", ".json")]
    if not out.parent.is_dir() or any(file.exists() and file.samefile(urdf) for file in files):
        raise InputError(
            f"--out is {out}; give a name in a folder that exists, other than the nominal arm's."
        )
    settings = profile_tree(profile)
    seatings = _seatings(folder)
    require_sockets(seatings)
    console = Console(highlight=False)
    if len(seatings) < SEATED:
        console.print(
            f"{len(seatings)} seatings hardly distinguish the joints; seat the ball in {SEATED} sockets or "
            "more, far apart.",
            style="yellow",
        )
    model = Arm(Robot(urdf, tip=link), link)
    torch.manual_seed(seed)
    with console.status("calibrating"):
        proposal = laplace_proposal(model, seatings)
        population = importance_sampling(
            arm_calibration, (model, seatings), observations(seatings), particles, proposal
        )
    draws = population.trace, normalised(population.log_weights)
    with replacing(files[0]) as beside:
        beside.write_text(corrected(urdf, corrected_joints(model, *draws)), encoding="utf-8")
    left = remaining_error(model, Robot(files[0], tip=link), *draws, seatings)
    settings["kinematics"] = [left.deviation, left.length]
    with replacing(files[1]) as beside:
        beside.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
    console.print(
        f"the seated ball scattered by {1e3 * left.before:.2f} mm by the nominal arm and by "
        f"{1e3 * left.after:.2f} mm by the calibrated one (effective draws: "
        f"{population.effective_sample_size:.0f} of {particles})."
    )
    console.print(
        f"positions are left uncertain by {1e3 * left.deviation:.2f} mm over {1e3 * left.length:.0f} mm; the "
        f"arm is in {files[0]}, and `bcppl run --set profile={files[1]}` takes it to be so.",
        markup=False,
    )


def _seatings(folder: Path) -> list[Tensor]:
    from bcppl.models.arm_calibration import read_seatings

    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; give the one of the recorded joint angles.")
    places = sorted(place for place in folder.iterdir() if place.is_dir() and any(place.glob("hole_*.csv")))
    return [seated for place in places or [folder] for seated in read_seatings(place)]
