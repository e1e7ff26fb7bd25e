"""Names the folders of a command, and writes into them."""

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gpmpc._files import write_whole
from gpmpc.exceptions import GpmpcError, SettingError


def folder_of(folder: Any) -> Path:
    """Returns the folder that the setting ``folder`` names."""
    if not isinstance(folder, str) or not folder.strip():
        raise SettingError("folder", f"must be the path of a folder; got {folder!r}")
    return Path(folder)


@contextmanager
def writing(folder: Path, key: str = "folder") -> Iterator[None]:
    """Turns errors of writing to ``folder`` into one of the setting that named it.

    Errors that name no file, such as of a full disk, are taken for some of these. Those
    of other files, such as of data that cannot be read, are raised as they are.
    """
    try:
        yield
    except OSError as error:
        if not _concerns(error, folder):
            raise
        raise SettingError(
            key, f"cannot write to {folder}: {error.strerror or error}"
        ) from error


def _concerns(error: OSError, folder: Path) -> bool:
    """Whether an error is of a folder, of what is in it, or of one that it is in.

    One that names no file, such as of a full disk, counts as well.
    """
    if not isinstance(error.filename, str | bytes | os.PathLike):
        return True
    file = Path(os.path.abspath(os.fsdecode(error.filename)))
    absolute = Path(os.path.abspath(folder))
    # Where ``folder`` is a file, that is written beside it first.
    is_beside = file.parent == absolute.parent
    is_partial = is_beside and file.name.startswith(f".{absolute.name}.")
    is_inside = file.is_relative_to(absolute)
    return is_inside or is_partial or absolute.is_relative_to(file)


def write_files(
    folder: Path, files: Mapping[str, str | bytes], key: str = "folder"
) -> str:
    """Writes files, each in one piece, and makes the folder.

    Returns:
        The line that says so.
    """
    with writing(folder, key):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(folder / name, content)
    return f"written to {folder}: {', '.join(sorted(files))}"


def working_folder() -> str:
    """Returns the working folder.

    Raises:
        GpmpcError: It is gone; libraries that are loaded there may end the process.
    """
    try:
        return os.getcwd()
    except OSError as error:
        raise GpmpcError(
            "the working folder is gone; change to one that exists"
        ) from error


def find_modules_here() -> None:
    """Lets ``_target_`` name modules of the working folder, behind all installed ones.

    Only where they are to be called: whoever asks for help, or presses TAB, in a folder
    of somebody else's runs nothing of it. Hydra, which imports what is called like a
    plugin of its own, has looked for plugins before.
    """
    folder = working_folder()
    if folder not in sys.path:
        sys.path.append(folder)
