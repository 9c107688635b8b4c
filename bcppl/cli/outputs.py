"""Files that a command is asked to write."""

from __future__ import annotations

from pathlib import Path

from bcppl.errors import InputError


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
