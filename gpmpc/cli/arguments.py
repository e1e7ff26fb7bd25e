"""Arguments of commands, and the folders that they name: a user's mistake is one line."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from gpmpc.exceptions import GpmpcError, SettingError


class Parser(argparse.ArgumentParser):
    """A parser that raises an error of this package instead of printing the usage and exiting."""

    def __init__(self, *arguments: Any, description: str | None = None, **settings: Any):
        plain = description and description.replace("``", "")  # a module's docstring, without its markup
        super().__init__(*arguments, description=plain, **settings)

    def error(self, message: str) -> NoReturn:
        """Raises instead of exiting.

        Raises:
            GpmpcError: Always.
        """
        raise GpmpcError(f"{message}; {self.prog} --help shows how")


def folder_of(folder: Any) -> Path:
    """Returns the folder that the setting ``folder`` names.

    Raises:
        SettingError: It is no text, or empty.
    """
    if not isinstance(folder, str) or not folder.strip():
        raise SettingError("folder", f"must be the path of a folder; got {folder!r}")
    return Path(folder)


@contextmanager
def writing(folder: Path, key: str = "folder") -> Iterator[None]:
    """Turns errors of writing to ``folder`` into one of the setting ``key``, which named it.

    Raises:
        SettingError: The folder cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise SettingError(key, f"cannot write to {folder}: {error.strerror or error}") from error
