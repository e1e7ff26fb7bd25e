"""Prints the lowest versions that ``pyproject.toml`` allows, as constraints for pip.

    python .ci/floors.py [NAME=VERSION ...] > floors.txt

pip always takes the highest versions that fit. A floor has to be a release that exists:
it is what ``make floors`` installs. Packages without a floor of their own are left to
pip. A version that is named on the command line takes the place of a floor; for torch,
whose lowest version cannot be had everywhere, that of ``constraints.txt`` does.
"""

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PINNED = "torch"  # as constraints.txt has it


def floors(project: Mapping[str, Any]) -> dict[str, str]:
    """Returns the lowest version of every package that a ``pyproject.toml`` asks for.

    Where several extras ask for one package, it is the highest of their floors: they
    are installed together.

    Raises:
        ValueError: A requirement has no floor, such as ``numpy`` or ``numpy<3``.
    """
    lowest: dict[str, str] = {}
    for text in _requirements(project):
        requirement = Requirement(text)
        name = canonicalize_name(requirement.name)
        versions = [
            part.version for part in requirement.specifier if part.operator == ">="
        ]
        if len(versions) != 1:
            raise ValueError(f"{text}: must have one floor, such as {name}>=1.0")
        known = lowest.get(name, versions[0])
        lowest[name] = max(known, versions[0], key=Version)
    return lowest


def _requirements(project: Mapping[str, Any]) -> Iterator[str]:
    """Yields what the build, the package and its extras require."""
    yield from project["build-system"]["requires"]
    yield from project["project"]["dependencies"]
    for extra in project["project"]["optional-dependencies"].values():
        yield from extra


def pinned_version(constraints: str, name: str) -> str:
    """Returns the version that a file of constraints pins a package to."""
    for line in constraints.splitlines():
        requirement = line.partition(";")[0].strip()
        if requirement.startswith(f"{name}=="):
            return requirement.partition("==")[2]
    raise ValueError(f"{name} is not pinned")


def main(arguments: list[str]) -> None:
    """Prints one constraint a line."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    versions = floors(project) | {PINNED: pinned_version(constraints, PINNED)}
    for argument in arguments:
        name, _, version = argument.partition("=")
        versions[canonicalize_name(name)] = version
    for name in sorted(versions):
        print(f"{name}=={versions[name]}")


if __name__ == "__main__":
    main(sys.argv[1:])
