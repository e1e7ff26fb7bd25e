"""Pages do what they say for a reader who pastes their blocks, one after the other.

A block without a language, or of ``bash``, holds commands that a shell takes as they
stand; what is printed, or cannot run on every machine, is ``text``. A block whose first
line is a comment with a file's name is that file. Every page begins in an empty folder.
"""

import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gpmpc.cli._commands import COMMANDS
from tests.pages import BLOCK, FILE, ROOT, read

PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in ROOT.glob("docs/*.md"))]
SHELL = ("", "bash")
PROGRAMS = {
    "cc",
    "gpmpc",
    "python",
    "python3",
    "cd",
    "git",
    "pip",
    "make",
    "export",
    "eval",
    "unset",
}
INSTALLS = ("git ", "pip ")
# Their commands run in a checkout, for minutes or hours, or on a cluster.
OF_A_CHECKOUT = {"performance.md", "league.md", "paper.md", "paper_flights.md"}
OF_A_CLUSTER = {"launchers.md"}
# Read flights of the reader's own: tests/logs/test_guide.py brings them.
OF_OWN_FLIGHTS = {"guide_log.md"}
NOT_RUN = OF_A_CHECKOUT | OF_A_CLUSTER | OF_OWN_FLIGHTS
DRIVER = """
import json, os, subprocess, sys
names = {"__name__": "__main__"}
sys.path.insert(0, "")
for kind, text in json.load(open(sys.argv[1])):
    if kind == "python":
        exec(compile(text, "page", "exec"), names)
    elif kind == "bash":
        shell = ["bash", "-e", "-o", "pipefail", "-c", text + "\\npwd > $PLACE"]
        subprocess.run(shell, check=True)
        os.chdir(open(os.environ["PLACE"]).read().strip())
    else:
        os.makedirs(os.path.dirname(kind) or ".", exist_ok=True)
        open(kind, "w").write(text)
"""


def is_printed(text):
    """Whether a block shows what the command before it prints."""
    return text.startswith(" ")


def commands(path):
    """Returns the blocks of commands of a page."""
    return [
        text
        for language, text in BLOCK.findall(read(path))
        if language in SHELL and not is_printed(text)
    ]


def lines(text):
    """Returns the commands of a block, each as its words, without comments."""
    joined = text.replace("\\\n", " ")
    split = [shlex.split(line, comments=True) for line in joined.splitlines()]
    # Settings of the environment stand before a command.
    commands = [
        list(itertools.dropwhile(re.compile(r"[A-Z_]+=").match, words))
        for words in split
    ]
    return [words for words in commands if words]


def check_gpmpc(words):
    """Fails unless the command line takes these words, and nothing is left over."""
    name, *rest = [word for word in words if not word.startswith("$")]
    if name.startswith("-"):
        return
    assert name in COMMANDS, words
    command = COMMANDS[name]
    ends = [k for k, word in enumerate(rest) if word in ("|", ">", "&&", ";")]
    rest = rest[: ends[0]] if ends else rest
    rest = [word for word in rest if word not in ("--json", "--quiet", "--debug")]
    parsed, unknown = command.parser(name).parse_known_intermixed_args(rest)
    assert not unknown, (words, unknown)
    for word in getattr(parsed, "overrides", []):
        assert "=" in word, (words, word)


@pytest.mark.parametrize("path", PAGES)
def test_a_shell_takes_the_commands_of_a_page_as_they_stand(path):
    for text in commands(path):
        checked = subprocess.run(
            ["bash", "-n"], input=text, text=True, capture_output=True, check=False
        )
        assert not checked.returncode, f"{text}\n{checked.stderr}"
        for words in lines(text):
            program = words[0]
            assert Path(program).name in PROGRAMS or "/" in program, words
            if program == "gpmpc":
                check_gpmpc(words[1:])


def blocks_to_run(path):
    """Returns what a reader pastes: kinds, or names of files, with their texts."""
    blocks = []
    for language, text in BLOCK.findall(read(path)):
        if written := FILE.match(text):
            blocks.append((written[1], text))
        elif language == "python":
            blocks.append(("python", text))
        elif language in SHELL and not text.startswith((" ", *INSTALLS)):
            blocks.append(("bash", text))
    return blocks


def needs(path):
    """Returns the optional libraries that a page needs."""
    return ["gymnasium", "mujoco"] if path.endswith("guide_simulator.md") else []


FOLLOWED = [
    path for path in PAGES if Path(path).name not in NOT_RUN and blocks_to_run(path)
]


@pytest.mark.slow
@pytest.mark.parametrize("path", FOLLOWED)
def test_a_page_runs_as_pasted_from_an_empty_folder(path, tmp_path):
    for library in needs(path):
        pytest.importorskip(library)
    folder = tmp_path / "empty"
    programs = tmp_path / "bin"
    folder.mkdir()
    programs.mkdir()
    for name, call in (("python", '"$@"'), ("gpmpc", '-m gpmpc "$@"')):
        (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {call}\n')
        (programs / name).chmod(0o755)
    (tmp_path / "blocks.json").write_text(json.dumps(blocks_to_run(path)))
    (tmp_path / "driver.py").write_text(DRIVER)
    environment = os.environ | {
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "PLACE": str(tmp_path / "place"),
        "MPLBACKEND": "Agg",
    }
    done = subprocess.run(
        [sys.executable, tmp_path / "driver.py", tmp_path / "blocks.json"],
        cwd=folder,
        env=environment,
        text=True,
        capture_output=True,
        timeout=1800,
        check=False,
    )
    assert not done.returncode, f"{done.stdout[-2000:]}\n{done.stderr[-3000:]}"


def test_every_page_that_shows_code_is_followed():
    shown = {path for path in PAGES if re.search(r"^```python", read(path), re.M)}
    assert {Path(path).name for path in shown - {*FOLLOWED}} <= OF_OWN_FLIGHTS
