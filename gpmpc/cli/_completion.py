"""``gpmpc completion``: what may come next on the command line, and the scripts that ask for it at TAB."""

import argparse
import glob
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from gpmpc.cli._command import COMMANDS, FLAGS, Result
from gpmpc.cli._settings import group_options, setting_names, settings
from gpmpc.exceptions import GpmpcError

_SCRIPTS = Path(__file__).with_name("completion")  # a file a shell


def completion(given: argparse.Namespace) -> Result:
    """Prints a shell's script, or what may come next."""
    if given.line is not None:
        found = candidates(given.line)
    elif given.shell:
        found = [(_SCRIPTS / f"{given.shell}.txt").read_text(encoding="utf-8").rstrip()]
    else:
        raise GpmpcError("completion: name a shell: bash, zsh, fish")
    print("\n".join(found))
    return Result(found)


def candidates(line: str) -> list[str]:
    """Returns the words that the last word of a line, up to the cursor, may become."""
    words = [*line.split(), *[""] * line.endswith(" ")][1:] or [""]
    name = words[0]
    before = words[1:-1]
    word = words[-1]
    if len(words) == 1 or (name == "help" and not before):
        found: Sequence[str] = [*COMMANDS]
    else:
        found = _after(name, before, word) if name in COMMANDS else []
    return [each for each in found if each.startswith(word)]


def _after(name: str, before: Sequence[str], word: str) -> Sequence[str]:
    """Returns what may stand behind a command and the words before the last one."""
    values = COMMANDS[name].values
    if before and values.get(before[-1]) is not None:
        return values[before[-1]] or _files(word)
    if word.startswith("-"):
        return [option for option in (*values, *FLAGS) if option.startswith("--")]
    if COMMANDS[name].settings:
        return _settings(name, before, word)
    places = [choices for key, choices in values.items() if not key.startswith("-")]
    return (places[len(before)] if len(before) < len(places) else None) or _files(word)


def _settings(name: str, before: Sequence[str], word: str) -> list[str]:
    """Returns settings, one level at a time, or the options of a group; of a sweep, behind the last comma."""
    with settings():
        groups = group_options(name)
        names = setting_names(name)
        with suppress(
            Exception
        ):  # what was typed before may be no setting yet, or a sweep
            names = setting_names(name, [each for each in before if "=" in each])
    key, equals, value = word.partition("=")
    if equals:
        if key == "folder" or key.endswith(".folder"):
            return [f"{key}={path}" for path in _files(value)]
        head = value[: value.rfind(",") + 1]
        return [f"{key}={head}{option}" for option in groups.get(key, [])]
    nodes = {each.rpartition(".")[0] for each in names}
    parent = key.rpartition(".")[0]
    level = [
        each
        for each in names
        if each.rpartition(".")[0] == parent and not each.endswith("_")
    ]  # as _target_
    leaves = [
        f"{each}="
        for each in dict.fromkeys([*groups, *level])
        if each in groups or each not in nodes
    ]
    return leaves + [
        f"{each}."
        for each in level
        if each in nodes and (each not in groups or each == word)
    ]


def _files(word: str) -> list[str]:
    found = sorted(glob.glob(f"{glob.escape(os.path.expanduser(word))}*"))
    return [f"{path}/" if os.path.isdir(path) else path for path in found]
