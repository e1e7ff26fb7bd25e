"""Arguments of commands, what commands return, and the folders that they write to: a user's mistake is one line."""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from gpmpc.exceptions import GpmpcError, SettingError


class Result(NamedTuple):
    """What a command returns."""

    data: Any = None  # plain data, which ``--json`` prints
    code: int = 0  # the exit code


class Parser(argparse.ArgumentParser):
    """A parser that raises an error of this package instead of printing the usage and exiting."""

    def __init__(self, *arguments: Any, **settings: Any):
        self.values: dict[str, list[str] | None] = {}  # by option or name: choices, empty for any; None for a flag
        super().__init__(*arguments, **settings)

    def add_argument(self, *names: Any, **settings: Any) -> Any:
        flag = settings.get("action") in ("store_true", "help")
        self.values |= dict.fromkeys(names, None if flag else [*settings.get("choices", ())])
        return super().add_argument(*names, **settings)

    def error(self, message: str) -> NoReturn:
        raise GpmpcError(f"{message}; {self.prog} --help shows how")


class Command(NamedTuple):
    """One command."""

    summary: str  # for the list of all
    task: Callable[[Any], Result]  # from the composed settings, or from the parsed arguments, to the result
    settings: str = ""  # name of its file in ``conf/``; empty where it has arguments only
    add_arguments: Callable[[Parser], None] = lambda parser: None  # to its parser

    def parser(self, name: str) -> Parser:
        """Returns the parser of what follows the command's name."""
        description = f"gpmpc {name}: {self.summary[0].lower()}{self.summary[1:]}."
        parser = Parser(prog=f"gpmpc {name}", description=description, add_help=not self.settings)
        self.add_arguments(parser)
        if self.settings:
            parser.add_argument("-h", "--help", action="store_true")
            parser.add_argument("--cfg", action="store_true")
            for name in ("--config-name", "--config-dir"):
                parser.add_argument(name)
            parser.add_argument("overrides", nargs="*")
        return parser


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


def write_files(folder: Path, files: Mapping[str, str | bytes], key: str = "folder") -> str:
    """Writes files, each in one piece, and makes the folder; returns the line that says so."""
    from gpmpc.files import write_whole

    with writing(folder, key):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(folder / name, content)
    return f"written to {folder}: {', '.join(sorted(files))}"
