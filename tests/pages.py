"""Follows a page of the documentation as a reader would.

Its files are written; its Python and its commands run in order.
"""

import re
import shlex
import sys
from pathlib import Path

from tests.cli.command import forked

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```([\w{}-]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(
    r"(?:# @package [\w.]+\n)?(?:#|<!--) ([\w/]+\.(?:py|yaml|xml))(?: -->)?\n"
)
INSTALLATION = ("git ", "pip ", "gpmpc warmup")  # what a test has done already


def read(path):
    return (ROOT / path).read_text()


def follow(path, folder, section="", shortened=()):
    """Does what a page, or what follows a heading of it, says in a folder.

    Args:
        path: Of the page.
        folder: In which it is followed.
        section: The heading.
        shortened: Words of commands and their replacements, for long flights.

    Returns:
        The names that its Python leaves, and what each command printed.
    """
    names: dict = {"__name__": "page"}
    printed = []
    for language, text in BLOCK.findall(
        read(path).partition(section)[2] if section else read(path)
    ):
        if written := FILE.match(text):
            (folder / written[1]).parent.mkdir(exist_ok=True)
            (folder / written[1]).write_text(text)
        elif language == "python":
            exec(compile(text, path, "exec"), names)
        elif not language:
            for words, fewer in shortened:
                assert words in read(path)
                text = text.replace(words, fewer)
            printed += _run(text, folder)
    return names, printed


def _run(text, folder):
    printed = []
    for line in text.splitlines():
        program, *arguments = shlex.split(line, comments=True) or [""]
        if program == "cd" and not text.startswith(INSTALLATION):
            folder /= arguments[0]
        elif program == "gpmpc" and not line.startswith(INSTALLATION):
            paths = [
                sorted(folder.glob(argument)) if "/*/" in argument else []
                for argument in arguments
            ]
            arguments = [
                str(*path) if path else argument
                for path, argument in zip(paths, arguments, strict=True)
            ]
            done = forked(*arguments, cwd=folder)
            assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
            printed.append(done.stdout)
    return printed


def forget_modules_of(folder, loaded):
    """Unloads modules that were imported from a folder since."""
    for name in set(sys.modules) - loaded:
        if str(folder) in (getattr(sys.modules[name], "__file__", None) or ""):
            del sys.modules[name]
