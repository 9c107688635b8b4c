"""A file of the REASSEMBLE data set as a recording of touches, by the configuration of `bcppl import bench`.

    bcppl import reassemble 2025-01-09-13-59-54.h5 --write bench.yaml    # what is in it, and a configuration
    bcppl import reassemble 2025-01-09-13-59-54.h5 bench.yaml -o recording.h5

REASSEMBLE (Sliwowski et al., Demonstrating REASSEMBLE, RSS 2025, arXiv:2502.05086) has forces, poses and
joint angles of a Franka arm at the NIST task board; its cameras have no depth. The layout is that of section
Dataset Structure in README.md of github.com/TUWIEN-ASL/REASSEMBLE, with REASSEMBLE/io.py there, by which the
torques are `compensated_base_torque` (README writes `compenseted`); see `reading`. What the arrays mean:

- `pose` is the end effector O_T_EE in the robot's base, m and a quaternion w x y z (README, io.py; topics of
  catkin_reas/src/record_teleop/launch/record.launch);
- `measured_force` is the sensor's reading in its own axes (topic ft_raw), `compensated_base_force` the one
  without the tool's weight in the base's axes, whose torques are about the base's origin (topic
  ft_compensated_base; catkin_reas/src/aidin_ros/scripts/force_2_base.py). No document states their sign;
- stamps and segments are on one clock, in Unix seconds.
"""

from pathlib import Path
from typing import Annotated

import typer

from bcppl.recordings.importers import Configuration, Draft, Imported

NAME = "reassemble"
HELP = (
    "A file of REASSEMBLE (wrench, poses, joints), by the configuration of `import bench` with arrays' names."
)


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file DATE-TIME.h5 of the data set.")],
    configuration: Configuration = None,
    write: Draft = None,
) -> Imported:
    """Read the streams of a file that a configuration describes; its other paths are relative to it.

    Raises:
        InputError: the file is damaged or lacks an array, or as `bcppl import bench`.
        typer.Exit: without a configuration, after the arrays are listed.
    """
    from bcppl.recordings.importers.bench.arrays import ArrayLog
    from bcppl.recordings.importers.bench.configuration.drafts import refuse_both
    from bcppl.recordings.importers.bench.log import imported
    from bcppl.recordings.importers.reassemble import draft
    from bcppl.recordings.importers.reassemble.reading import ReassembleArrays

    if configuration is None:
        draft.show(Path(file), write)
        raise typer.Exit
    refuse_both(write, "file")
    path = Path(configuration)
    return imported(path, lambda fields: ArrayLog(ReassembleArrays(Path(file), fields), path.parent, "wxyz"))
