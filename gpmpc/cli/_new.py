"""``gpmpc new``: writes a project of the user's own around a system."""

import argparse
import keyword
import re
from importlib.util import find_spec
from pathlib import Path

from gpmpc.cli._commands import Result
from gpmpc.cli._folders import write_files
from gpmpc.cli._settings import config_folder
from gpmpc.exceptions import SettingError

# Files, named and written for a system called NAME.
_TEMPLATES = Path(__file__).with_name("project")
_OTHER_MODULES = ("fly", "conftest")  # of the project, or of pytest in it
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
    """Raises where a name is none of a module of Python, or means something else.

    Of a file of settings gpmpc's own is found first, of a module the installed one.
    """
    is_word = name.isidentifier() and name.isascii() and not name.startswith("_")
    if not is_word:
        raise SettingError(
            "NAME", f"must be letters, digits and _, a letter first; got {name!r}"
        )
    owner = ""
    if keyword.iskeyword(name):
        owner = "a keyword of Python"
    elif (config_folder() / "system" / f"{name}.yaml").exists():
        owner = "a system of gpmpc"
    elif name in _OTHER_MODULES:
        owner = "a file of the project"
    elif _is_module(name):
        owner = "a module that Python finds already"
    if owner:
        raise SettingError("NAME", f"{name} is the name of {owner}; choose another")


def _is_module(name: str) -> bool:
    """Whether a module or package of some name is installed; a bare folder is none."""
    spec = find_spec(name)
    return spec is not None and spec.origin is not None
