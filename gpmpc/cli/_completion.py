"""``gpmpc completion``: what may come next on a line, and scripts that ask for it."""

import argparse
import glob
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from gpmpc.cli._commands import COMMANDS, FLAGS, Result
from gpmpc.cli._settings import group_options, setting_names, settings_folders
from gpmpc.exceptions import GpmpcError

_SCRIPTS = Path(__file__).with_name("completion")  # a file a shell


def completion(arguments: argparse.Namespace) -> Result:
    """Prints a shell's script, or what may come next."""
    if arguments.line is not None:
        lines = candidates(arguments.line)
    elif arguments.shell:
        script = _SCRIPTS / f"{arguments.shell}.txt"
        lines = [script.read_text(encoding="utf-8").rstrip()]
    else:
        raise GpmpcError("completion: name a shell: bash, zsh, fish")
    print("\n".join(lines))
    return Result(lines)


def candidates(line: str) -> list[str]:
    """Returns the words that the last word of a line, up to the cursor, may become."""
    typed = line.split()[1:]
    if line.endswith(" ") or not typed:
        typed.append("")
    name = typed[0]
    before = typed[1:-1]
    word = typed[-1]
    names_a_command = len(typed) == 1 or (name == "help" and not before)
    if names_a_command:
        choices = [*COMMANDS]
    elif name in COMMANDS:
        choices = _after_command(name, before, word)
    else:
        choices = []
    return [choice for choice in choices if choice.startswith(word)]


def _after_command(name: str, before: Sequence[str], word: str) -> list[str]:
    """Returns what may stand behind a command and the words before the last one."""
    arguments = COMMANDS[name].values_by_argument
    if before and arguments.get(before[-1]) is not None:  # the value of an option
        return arguments[before[-1]] or _files(word)
    if word.startswith("-"):
        return [option for option in (*arguments, *FLAGS) if option.startswith("--")]
    if COMMANDS[name].has_settings:
        return _settings(name, before, word)
    positional = [
        values for key, values in arguments.items() if not key.startswith("-")
    ]
    if len(before) < len(positional):
        return positional[len(before)] or _files(word)
    return _files(word)


def _settings(name: str, before: Sequence[str], word: str) -> list[str]:
    """Returns settings that may follow, or what may stand behind the = of one."""
    with settings_folders():
        groups = group_options(name)
        names = setting_names(name)
        # What was typed before may be no setting yet, or a sweep.
        with suppress(Exception):
            names = setting_names(name, [each for each in before if "=" in each])
    key, equals, value = word.partition("=")
    if not equals:
        return _keys(key, names, groups)
    if key == "folder" or key.endswith(".folder"):
        return [f"{key}={path}" for path in _files(value)]
    swept = value[: value.rfind(",") + 1]  # up to the last comma
    return [f"{key}={swept}{option}" for option in groups.get(key, [])]


def _keys(key: str, names: Sequence[str], groups: dict[str, list[str]]) -> list[str]:
    """Returns settings one level at a time: ``KEY=`` of a value, ``KEY.`` of a node."""
    nodes = {_parent(name) for name in names}
    level = [
        name
        for name in names
        if _parent(name) == _parent(key) and not name.endswith("_")  # as _target_
    ]
    with_value = [
        f"{name}="
        for name in dict.fromkeys([*groups, *level])
        if name in groups or name not in nodes
    ]
    with_settings_below = [
        f"{name}."
        for name in level
        if name in nodes and (name not in groups or name == key)
    ]
    return with_value + with_settings_below


def _parent(name: str) -> str:
    return name.rpartition(".")[0]


def _files(word: str) -> list[str]:
    beginning = glob.escape(os.path.expanduser(word))
    paths = sorted(glob.glob(f"{beginning}*"))
    return [f"{path}/" if os.path.isdir(path) else path for path in paths]
