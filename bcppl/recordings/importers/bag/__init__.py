"""A ROS 1 or ROS 2 bag or an MCAP file as a recording, by the configuration of `bcppl import bench`.

    bcppl import bag touches.bag --write bench.yaml     # what is in it, and a configuration to be edited
    bcppl import bag touches.bag bench.yaml -o recording.h5

There, streams name topics in place of files. One file for each step: `reading` (messages of a bag), `rows`,
`transforms` and `images` (what becomes of them), `bag_log` (a log of one pass over a bag, read by `bench`),
and `draft` (a configuration with guesses).
"""

from pathlib import Path
from typing import Annotated

import typer

from bcppl.recordings.importers import Configuration, Draft, Imported

NAME = "bag"
HELP = "A ROS 1 or ROS 2 bag or an MCAP file, by the configuration of `import bench` with topics for files."


def command(
    bag: Annotated[
        Path, typer.Argument(metavar="BAG", help="A .bag or .mcap file, or a ROS 2 bag's folder.")
    ],
    configuration: Configuration = None,
    write: Draft = None,
) -> Imported:
    """Read the streams of a bag that a configuration describes; its other paths are relative to it.

    Raises:
        InputError: the bag is damaged or lacks a topic, or as `bcppl import bench`.
        typer.Exit: without a configuration, after the topics are listed.
    """
    from bcppl.recordings.importers.bag import draft
    from bcppl.recordings.importers.bag.bag_log import BagLog
    from bcppl.recordings.importers.bench.configuration.drafts import refuse_both
    from bcppl.recordings.importers.bench.log import imported

    if configuration is None:
        draft.show(Path(bag), write)
        raise typer.Exit
    refuse_both(write, "bag")
    path = Path(configuration)
    return imported(path, lambda fields: BagLog(Path(bag), fields, path.parent))
