"""``gpmpc completion``: what may come next on the command line, and the scripts that ask for it at TAB."""

import argparse
import glob
import os
import shlex
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
    try:
        words = shlex.split(line)
    except ValueError:  # inside of quotes
        return []
    if not line or line[-1].isspace():
        words.append("")
    _, *middle, word = words if len(words) > 1 else ["gpmpc", *words]
    if not middle or middle == ["help"]:
        found: Sequence[str] = [*COMMANDS]
    elif middle[0] not in COMMANDS:
        found = []
    else:
        found = _after(middle[0], middle[1:], word)
    return [each for each in found if each.startswith(word)]


def _after(name: str, before: Sequence[str], word: str) -> Sequence[str]:
    """Returns what may stand behind a command and the words before the last one."""
    values = COMMANDS[name].values(name)
    if before and values.get(before[-1]) is not None:
        return values[before[-1]] or _files(word)
    if word.startswith("-"):
        return [option for option in (*values, *FLAGS) if option.startswith("--")]
    if COMMANDS[name].settings:
        return _settings(COMMANDS[name].settings, before, word)
    places = [key for key in values if not key.startswith("-")]
    place = sum(not each.startswith("-") for each in before)
    return (values[places[place]] if place < len(places) else None) or _files(word)


def _settings(name: str, before: Sequence[str], word: str) -> list[str]:
    """Returns settings, one level at a time, or the options of a group; of a sweep, behind the last comma."""
    chosen = [each for each in before if "=" in each]
    with settings():
        groups, names = group_options(name), setting_names(name)
        with suppress(Exception):  # what was typed before may be no setting yet, or a sweep
            names = setting_names(name, chosen)
    key, equals, value = word.partition("=")
    if equals:
        if key == "folder" or key.endswith(".folder"):
            return [f"{key}={path}" for path in _files(value)]
        head = value[: value.rfind(",") + 1]
        return [f"{key}={head}{option}" for option in groups.get(key, [])]
    nodes, parent = {each.rpartition(".")[0] for each in names}, key.rpartition(".")[0]
    level = [each for each in names if each.rpartition(".")[0] == parent and not each.endswith("_")]  # as _target_
    leaves = [f"{each}=" for each in dict.fromkeys([*groups, *level]) if each in groups or each not in nodes]
    return leaves + [f"{each}." for each in level if each in nodes and (each not in groups or each == word)]


def _files(word: str) -> list[str]:
    found = sorted(glob.glob(f"{glob.escape(os.path.expanduser(word))}*"))
    return [f"{path}/" if os.path.isdir(path) else path for path in found]
