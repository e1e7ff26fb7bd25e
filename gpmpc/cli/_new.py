"""``gpmpc new``: writes a project of the user's own around a system."""

import argparse
import keyword
import re
from pathlib import Path

from gpmpc.cli._commands import Result
from gpmpc.cli._folders import write_files
from gpmpc.exceptions import SettingError

# Files, named and written for a system called NAME.
_TEMPLATES = Path(__file__).with_name("project")
_FILES = {
    "NAME.py": "system.txt",
    "system/NAME.yaml": "settings.txt",
    "fly.py": "script.txt",
    "test_NAME.py": "test.txt",
}


def new(arguments: argparse.Namespace) -> Result:
    """Writes a system, its settings, a script and a test; prints how it is run."""
    name = arguments.name
    folder = arguments.to or Path(name)
    _check_name(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SettingError(
            "to", f"{folder} is not an empty folder; nothing was written"
        )
    replacements = {"NAME": name, "CLASS": name.title().replace("_", "")}
    files: dict[str, str | bytes] = {}
    for path, template in _FILES.items():
        text = (_TEMPLATES / template).read_text(encoding="utf-8")
        text = re.sub("NAME|CLASS", lambda match: replacements[match[0]], text)
        files[path.replace("NAME", name)] = text
    written = write_files(folder, files, "to")
    run = f"gpmpc run --config-dir . system={name}"
    sweep = f"{run} -m 'seed=range(5)' data.size=50,100,200"
    print(f"{written}\n")
    print(f"cd {folder}\n{run}\n{sweep}\npython fly.py\npytest")
    return Result({"folder": str(folder), "files": [*files], "command": run})


def _check_name(name: str) -> None:
    """Raises where a name cannot be that of a module of Python."""
    is_word = name.isidentifier() and name.isascii() and not name.startswith("_")
    if not is_word or keyword.iskeyword(name):
        raise SettingError(
            "NAME", f"must be letters, digits and _, a letter first; got {name!r}"
        )
