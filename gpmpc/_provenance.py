"""Collects what made a result: versions, source commit, code, machine, command.

A stored result is a result of the code that made it. Versions and commits do not name
that code: a version is that of the last release, and a commit does not know what was
changed since. So the code has a fingerprint of its own, and results that are stored to
be used again are stored under it.
"""

import ast
import hashlib
import os
import platform
import shlex
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gpmpc._trust import LOOKUPS, package_of
from gpmpc.exceptions import GpmpcError

# Endings of the files that results depend on: code, models for simulators, printed
# figures. Settings are no part of the code: every result names its own.
_SOURCES = (".py", ".xml", ".csv", ".c", ".h")
_NO_SOURCES = ("__pycache__", "conf")  # folders
# Of a user's own package: tables may stand beside the code that has written them.
_OWN_SOURCES = (".py", ".xml")

_LEAVES = (str, int, float, list, type(None))  # of plain data

_PACKAGES = ("gpmpc", "torch", "gpytorch", "numpy", "scipy", "casadi", "hydra-core")


def provenance() -> dict:
    """Returns what a reader needs to run the same again, as plain data."""
    return {
        "created": now(),
        "command": shlex.join([_program(Path(sys.argv[0])), *sys.argv[1:]]),
        "git": _git_commit(),
        "code": code_fingerprint_or_none(),
        "python": platform.python_version(),
        "versions": versions(),
        "machine": {
            "system": platform.system(),
            "processor": processor(),
            "cores": os.cpu_count(),
        },
    }


def _program(path: Path) -> str:
    """Returns what the program is called; ``python -m gpmpc`` is gpmpc."""
    return path.parent.name if path.name == "__main__.py" else path.name


@cache
def code_fingerprint() -> str:
    """Returns ``source_fingerprint`` of the code of this process; it is read once.

    Raises:
        GpmpcError: The source is not there, as in an archive or where it was compiled
            and removed: what such code has made cannot be told from other results.
    """
    return source_fingerprint(Path(__file__).resolve().parent)


def code_fingerprint_or_none() -> str | None:
    """Returns ``code_fingerprint``, or None where the source is not there."""
    try:
        return code_fingerprint()
    except GpmpcError:
        return None


def is_of_this_code(about: Mapping[str, Any], settings: Any = None) -> bool:
    """Returns whether a result was made by the code that would make it now.

    Args:
        about: What ``provenance`` returned where it was made. Where that does not tell
            the code, as that of older versions, it was other code.
        settings: Its settings, as plain data: they may name code of the user's own.
    """
    code = about.get("code")
    if code is None or code != code_fingerprint_or_none():
        return False
    return (about.get("own_code") or {}) == own_code(settings)


def source_fingerprint(package: Path) -> str:
    """Returns 32 digits that differ where any source file of gpmpc does.

    They are the same in a checkout and in what is installed from it, wherever that
    lies, whenever its files were written, and with either kind of line ending.

    Args:
        package: The folder ``gpmpc``.

    Raises:
        GpmpcError: No file has one of the endings that are looked for.
    """
    files = _source_files(package, "gpmpc")
    for ending in _SOURCES:
        if not any(name.endswith(ending) for name in files):
            raise GpmpcError(
                f"{package}: holds no *{ending}: gpmpc cannot tell which code has made "
                "a result without its source files"
            )
    return _digest(files)


def _source_files(
    folder: Path, prefix: str, endings: tuple[str, ...] = _SOURCES
) -> dict[str, Path]:
    """Returns the source files below a folder by their names below ``prefix``."""
    files: dict[str, Path] = {}
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name not in _NO_SOURCES]
        for name in names:
            if name.endswith(endings) and not name.startswith("."):
                path = Path(parent, name)
                files[f"{prefix}/{path.relative_to(folder).as_posix()}"] = path
    return files


def _digest(files: Mapping[str, Path]) -> str:
    """Returns 32 digits that differ where a name or a content does, line ends aside."""
    digest = hashlib.sha256()
    for name in sorted(files):
        content = files[name].read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()[:32]


def own_code(settings: Any) -> dict[str, str]:
    """Returns the fingerprints of the user's own code that settings name.

    ``_target_: my_robot.make_system`` runs ``my_robot``, which is edited between two
    runs as gpmpc is. It counts with all that it imports, up to what is installed:
    installed packages and the standard library are left out.

    Args:
        settings: Plain data, nested.

    Returns:
        One fingerprint a module or package that a name of code begins with.
    """
    names = sorted({package_of(name) for name in _names_of_code(settings)})
    fingerprints = {name: _own_fingerprint(name) for name in names}
    return {name: digits for name, digits in fingerprints.items() if digits}


def _names_of_code(settings: Any) -> Iterator[str]:
    """Yields every name of code in nested settings, however it is named there."""
    if isinstance(settings, Mapping):
        if isinstance(settings.get("_target_"), str):
            yield from _names_in_call(settings)
        for value in settings.values():
            yield from _names_of_code(value)
    elif isinstance(settings, list | tuple):
        for value in settings:
            yield from _names_of_code(value)


def _names_in_call(call: Mapping[str, Any]) -> Iterator[str]:
    """Yields what one ``_target_`` calls, looks up, imports, or lets a model name."""
    target = call["_target_"]
    yield target
    path = call.get("path")
    if target in LOOKUPS and isinstance(path, str):
        yield path
    environment = call.get("environment")
    if isinstance(environment, str) and ":" in environment:  # gymnasium imports it
        yield environment
    trusted = call.get("trusted")
    if isinstance(trusted, list | tuple):
        yield from (package for package in trusted if isinstance(package, str))


@cache
def _own_fingerprint(name: str) -> str:
    """Names the code of a package or module and of what it imports; "" if installed."""
    files: dict[str, Path] = {}
    waiting = [name]
    visited = {"gpmpc"}  # has its own fingerprint
    while waiting:
        package = waiting.pop()
        if package in visited:
            continue
        visited.add(package)
        own_files = _own_files(package)
        files |= own_files
        for path in own_files.values():
            if path.suffix == ".py":
                waiting += _imported_packages(path)
    return _digest(files) if files else ""


def _own_files(package: str) -> dict[str, Path]:
    """Returns the source files of a package or module; none where it is installed."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):  # no such module, or one without a file
        return {}
    if spec is None:
        return {}
    files: dict[str, Path] = {}
    for location in spec.submodule_search_locations or []:
        if not _is_installed(Path(location)):
            files |= _source_files(Path(location), package, _OWN_SOURCES)
    origin = Path(spec.origin or "")
    if origin.suffix == ".py" and not files and not _is_installed(origin):
        files[f"{package}.py"] = origin
    return files


def _is_installed(path: Path) -> bool:
    """Whether a file belongs to the standard library or to an installed package."""
    path = path.resolve()
    if {"site-packages", "dist-packages"} & {*path.parts}:
        return True
    library = Path(sysconfig.get_path("stdlib")).resolve()
    return path.is_relative_to(library)


def _imported_packages(path: Path) -> list[str]:
    """Returns the packages and modules that a file imports, by their first names."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):  # is told where it is imported
        return []
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.append(node.module)
    return [name.partition(".")[0] for name in names]


def flattened(data: Mapping[str, Any]) -> dict[str, Any]:
    """Returns nested data as one dictionary, keys dotted."""
    leaves: dict[str, Any] = {}
    _flatten(data, "", leaves)
    return leaves


def _flatten(data: Mapping[str, Any], prefix: str, leaves: dict[str, Any]) -> None:
    for key, value in data.items():
        # First what is decided quickly: most are.
        if isinstance(value, _LEAVES) or not isinstance(value, Mapping):
            leaves[f"{prefix}{key}"] = value
        else:
            _flatten(value, f"{prefix}{key}.", leaves)


def environment() -> dict[str, str | None]:
    """Returns versions, BLAS library and processor, a line each of a bug report."""
    import numpy as np

    configuration: Any = np.show_config(mode="dicts")
    blas = configuration["Build Dependencies"]["blas"]
    return {
        "gpmpc": version("gpmpc"),
        "python": platform.python_version(),
        **versions(("torch", "gpytorch", "numba", "numpy", "scipy", "casadi")),
        "BLAS": f"{blas['name']} {blas['version']}",
        "CPU": f"{processor()}, {os.cpu_count()} cores",
        "system": f"{platform.system()} {platform.release()}",
    }


def processor() -> str:
    """Returns the processor's name if the system tells it; else its architecture."""
    with (
        suppress(OSError),
        open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file,
    ):
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def now() -> str:
    """Returns the time in UTC, to the second (ISO 8601)."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str | None]:
    """Returns the installed versions by name; None of packages not installed."""
    return {name: _version(name) for name in packages}


@cache
def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


@cache
def _git_commit() -> dict | None:
    """Returns the checkout's commit, and whether it has uncommitted changes.

    They are those that this process has found: later ones are not what it runs.

    Returns None for an installed package.
    """
    root = Path(__file__).resolve().parents[1]
    if not (root / "pyproject.toml").exists():
        return None
    # Without the lock that refreshes the index: a run that is killed would leave it,
    # and git would refuse to commit.
    git = ["git", "--no-optional-locks", "-C", str(root)]
    run = partial(
        subprocess.check_output, stderr=subprocess.DEVNULL, text=True, timeout=10
    )
    try:
        return {
            "commit": run([*git, "rev-parse", "HEAD"]).strip(),
            "dirty": bool(run([*git, "status", "--porcelain"])),
        }
    except (OSError, subprocess.SubprocessError):
        return None
