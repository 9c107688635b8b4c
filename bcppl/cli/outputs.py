"""Files that a command is asked to write."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from bcppl.errors import InputError


def files_of_run(name: str | Path) -> list[Path]:
    """The files of a run, and its recording, where a command reads its folder or a file in it."""
    from bcppl.cli.run_folder import RECORD, STEP, read_record

    folder = Path(name) if Path(name).is_dir() else Path(name).parent
    if not (folder / RECORD).is_file():
        return []
    with suppress(InputError):
        named = Path(read_record(folder)["recording"])
        return [named, folder / RECORD, folder / STEP, *folder.glob("belief_*.h5")]
    return [folder / RECORD]


def refuse_overwriting(option: str, file: Path, *read: str | Path | None) -> None:
    """Refuse a file whose folder is not there, or that would take the place of one that is read.

    Args:
        option: that names the file, for the message.
        file: to be written.
        read: what the command reads: files, names that are none, or None.

    Raises:
        InputError: one sentence.
    """
    if not file.parent.is_dir():
        raise InputError(f"there is no folder {file.parent} to write {file.name} into; make it first.")
    for each in read:
        if each is not None and file.exists() and Path(each).exists() and file.samefile(each):
            raise InputError(f"{option} would overwrite {each}, which is read; give another name.")
