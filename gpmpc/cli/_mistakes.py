"""Turns a user's mistake into one line: which setting, what was got, what was expected."""

import difflib
import re
from collections.abc import Iterable

from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from gpmpc.cli._configuration import setting_names, settings
from gpmpc.cli._run import one_line, own_error
from gpmpc.exceptions import GpmpcError

_EXTRAS = {"submitit_slurm": "slurm", "submitit_local": "slurm", "ray": "ray"}  # that bring a launcher


def explain(error: Exception, name: str) -> str | None:
    """Returns a user's mistake in one line; None where the error is not the user's."""
    if isinstance(error, GpmpcError | HydraException | OmegaConfBaseException):
        return _of_settings(error, name)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if name and isinstance(error, TypeError | ValueError | ArithmeticError):  # a value that no check foresaw
        reason = " ".join(str(error).split()) or type(error).__name__
        return f"{reason}; is a setting of the wrong kind? --debug shows where"
    return None


def nearest(name: str, known: Iterable[str]) -> str:
    """Returns the name that a misspelt one stands for, as a question; by its last part where only that was typed."""
    known, leaf = sorted(known, key=lambda key: key.count(".")), lambda key: key.rpartition(".")[2]
    alone = "." not in name or leaf(name).lower() in {leaf(key).lower() for key in known}
    for part in (leaf,) if alone else (str, leaf):
        parts = {part(key).lower() for key in known}
        if close := difflib.get_close_matches(part(name).lower(), parts, n=1):
            meant = [key for key in known if part(key).lower() == close[0]]
            if "." in name:
                meant = difflib.get_close_matches(name, meant, n=1, cutoff=0.0)
            meant = [key for key in meant if "." not in key] or meant
            return f" (did you mean {' or '.join(map(repr, meant[:3]))}?)"
    return ""


def _of_settings(error: Exception, name: str) -> str:
    if own_error(error):
        return one_line(error)
    text = str(error)
    if unknown := re.match(r"Could not override '([^']+)'", text):
        with settings():
            known = setting_names(name)
        return f"unknown setting {unknown[1]!r}{nearest(unknown[1], known)}"
    option = re.search(r"Could not find '([^'/]+)/([^']+)'\s+Available options in '[^']+':\n((?:\t.*\n)+)", text)
    if option and (extra := _EXTRAS.get(option[2].removeprefix("launcher/"))):
        return f"launcher: this one is not installed: pip install 'gpmpc[{extra}]'"
    if option:
        known = option[3].split()
        available = f"available are {', '.join(known)}{nearest(option[2], known)}"
        return f"{option[1]}: no such option {option[2]!r}; {available}"
    if isinstance(error, OverrideParseException):
        if "=" not in error.override:
            return f"{error.override!r}: a setting is written SETTING=VALUE"
        quoted = "in single quotes where the value holds brackets, braces, commas or spaces"
        return f"{error.override!r}: cannot be read; a setting is written SETTING=VALUE, {quoted}"
    if unlocated := re.match(r"Error locating target '([^']+)'", text):
        return f"_target_: no such class or function {unlocated[1]!r}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: this setting has no default; give it as {error.full_key}=VALUE"
    if ambiguous := re.match(r"Ambiguous value for argument '([^=]+)=([^']+)'", text):
        listed = f"{ambiguous[1]}: a list is written in brackets, {ambiguous[1]}=[{ambiguous[2]}]"
        return f"{listed}; a sweep takes -m" if name == "run" else listed
    lines = [line.strip() for line in text.splitlines() if line.strip() and "hydra.cc" not in line]
    return "; ".join(line.rstrip(".:;") for line in lines) or type(error).__name__
