"""A robot bench's own log as a recording, by a configuration in YAML and without code.

    bcppl new bench bench.yaml      # a configuration with comments, to be edited
    bcppl import bench bench.yaml -o recording.h5

One file for each step: `configuration` (the fields and their file), `sources` (files, or what stands for
them: `arrays` of data sets, or a bag), `table` (columns of files), `in_order` and `pose_columns` (rows in
SI units), `clocks`, `wrenches`, `gravity`, `cutting`, `views`, `bodies`, and `log`, which takes them in turn.
"""

from pathlib import Path
from typing import Annotated

import typer

from bcppl.recordings.importers import Imported

NAME = "bench"
HELP = "A robot bench's own log (CSV, NumPy, Parquet; depth images; meshes), by a configuration in YAML."


def command(
    configuration: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="The configuration; `bcppl new bench` writes one.")
    ],
) -> Imported:
    """Read the log that a configuration describes; paths are relative to it.

    Raises:
        InputError: the configuration or a file that it names is missing or wrong, or the streams do not fit.
    """
    from bcppl.recordings.importers.bench.log import imported  # a second for scipy and pydantic

    return imported(Path(configuration))
