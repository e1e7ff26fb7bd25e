"""Arguments of commands, what commands return, and the folders that they write to: a user's mistake is one line."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from gpmpc.exceptions import GpmpcError, SettingError


class Result(NamedTuple):
    """What a command returns."""

    data: Any = None  # plain data, which ``--json`` prints
    code: int = 0  # the exit code


class Parser(argparse.ArgumentParser):
    """A parser that raises an error of this package instead of printing the usage and exiting.

    Attributes:
        values: What the arguments take, by option or name: a list of choices, empty for any; None for a flag.
    """

    def __init__(self, *arguments: Any, **settings: Any):
        self.values: dict[str, list[str] | None] = {}
        super().__init__(*arguments, **settings)

    def add_argument(self, *names: Any, **settings: Any) -> Any:
        """Adds an argument as ``argparse`` does."""
        flag = settings.get("action") in ("store_true", "help")
        self.values |= dict.fromkeys(names, None if flag else [*settings.get("choices", ())])
        return super().add_argument(*names, **settings)

    def error(self, message: str) -> NoReturn:
        """Raises instead of exiting."""
        raise GpmpcError(f"{message}; {self.prog} --help shows how")


def folder_of(folder: Any) -> Path:
    """Returns the folder that the setting ``folder`` names."""
    if not isinstance(folder, str) or not folder.strip():
        raise SettingError("folder", f"must be the path of a folder; got {folder!r}")
    return Path(folder)


@contextmanager
def writing(folder: Path, key: str = "folder") -> Iterator[None]:
    """Turns errors of writing to ``folder`` into one of the setting ``key``, which named it."""
    try:
        yield
    except OSError as error:
        raise SettingError(key, f"cannot write to {folder}: {error.strerror or error}") from error
