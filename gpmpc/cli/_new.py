"""``gpmpc new``: writes a project of the user's own, a system with its settings, a script and a test."""

import argparse
import keyword
import re
from pathlib import Path

from gpmpc.cli._command import Result
from gpmpc.cli._settings import write_files
from gpmpc.exceptions import SettingError

_TEMPLATES = Path(__file__).with_name(
    "project"
)  # its files, named and written for a system called NAME
_FILES = {
    "NAME.py": "system.txt",
    "system/NAME.yaml": "settings.txt",
    "fly.py": "script.txt",
    "test_NAME.py": "test.txt",
}


def new(given: argparse.Namespace) -> Result:
    """Writes the project, and prints how it is run."""
    name = given.name
    folder = given.to or Path(given.name)
    if (
        not name.isidentifier()
        or keyword.iskeyword(name)
        or not name.isascii()
        or name.startswith("_")
    ):
        raise SettingError(
            "NAME", f"must be letters, digits and _, a letter first; got {name!r}"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SettingError(
            "to", f"{folder} is not an empty folder; nothing was written"
        )
    named = {"NAME": name, "CLASS": name.title().replace("_", "")}
    files = {}
    for path, template in _FILES.items():
        text = (_TEMPLATES / template).read_text(encoding="utf-8")
        files[path.replace("NAME", name)] = re.sub(
            "NAME|CLASS", lambda found: named[found[0]], text
        )
    written = [*files]
    run = f"gpmpc run --config-dir . system={name}"
    print(write_files(folder, files, "to") + "\n")
    print(
        f"cd {folder}\n{run}\n{run} -m 'seed=range(5)' data.size=50,100,200\npython fly.py\npytest"
    )
    return Result({"folder": str(folder), "files": written, "command": run})
