"""A trajectory of the Functional Manipulation Benchmark, by the configuration of `bcppl import bench`.

    bcppl import fmb trajectory.npz --write bench.yaml      # what is in it, and a configuration
    bcppl import fmb trajectory.npz bench.yaml -o recording.h5

FMB (Luo et al., FMB: a Functional Manipulation Benchmark for Generalizable Robotic Learning, 2024,
arXiv:2401.08553) has four depth cameras, poses and wrenches of a Franka arm at 10 Hz. The names and shapes of
the arrays are those of its page functional-manipulation-benchmark.github.io/dataset and of the README.md of
huggingface.co/datasets/charlesxu0124/functional-manipulation-benchmark. It publishes each trajectory as a
pickled dictionary in an .npy file, which runs code when it is read and is refused here: the arrays are read
from an .npz file with the same names (docs/import_bench.md has the line that converts one).

Of what these pages leave open, github.com/rail-berkeley/fmb states in robot_infra: the quaternion is x y z w,
and the wrench is K_F_ext_hat_K, which libfranka estimates without the tool's weight
(robot_servers/franka_server.py); rows are steps of 10 Hz, without stamps (envs/franka_fmb_env.py). None of
these states intrinsics and poses of the cameras, or the unit of depth: the configuration has to.
"""

from pathlib import Path
from typing import Annotated

import typer

from bcppl.arguments import number_within
from bcppl.recordings.importers import Configuration, Draft, Imported

NAME = "fmb"
HELP = "A trajectory of FMB (wrench, poses, four depth cameras), by the configuration of `import bench`."


def command(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A trajectory's arrays, by their names in an .npz file.")
    ],
    configuration: Configuration = None,
    write: Draft = None,
    rate: Annotated[float, typer.Option(help="Rows per second, which the file does not state.")] = 10.0,
) -> Imported:
    """Read the streams and images of a trajectory that a configuration describes.

    Raises:
        InputError: the file is pickled, damaged or lacks an array, or as `bcppl import bench`.
        typer.Exit: without a configuration, after the arrays are listed.
    """
    from bcppl.recordings.importers.bench.configuration.drafts import refuse_both
    from bcppl.recordings.importers.bench.log import imported
    from bcppl.recordings.importers.fmb import draft
    from bcppl.recordings.importers.fmb.reading import FmbLog, Trajectory

    number_within("the trajectory has {} rows per second", rate, above=0.0)
    trajectory = Trajectory(Path(file), rate)
    if configuration is None:
        draft.show(trajectory, write)
        raise typer.Exit
    refuse_both(write, "file")
    path = Path(configuration)
    return imported(path, lambda fields: FmbLog(trajectory, fields, path.parent))
