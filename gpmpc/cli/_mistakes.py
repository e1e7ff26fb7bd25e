"""Explains an error that is the user's mistake in one line, in the package's words."""

import re
from collections.abc import Callable

from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from gpmpc.cli._settings import setting_names, settings_folders
from gpmpc.cli._spelling import nearest
from gpmpc.exceptions import GpmpcError


def explain(error: Exception, name: str) -> str | None:
    """Returns a user's mistake in one line; None where the error is not the user's."""
    if own_error(error):
        return one_line(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _of_settings(error, name)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    # A value that no check foresaw.
    if name and isinstance(error, TypeError | ValueError | ArithmeticError):
        reason = " ".join(str(error).split()) or type(error).__name__
        return f"{reason}; is a setting of the wrong kind? --debug shows where"
    return None


def _of_settings(error: Exception, name: str) -> str:
    """Returns an error of Hydra or OmegaConf in one line.

    A common one is said in the words of this package.
    """
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override!r}: cannot be read; a setting is written SETTING=VALUE, "
            "in single quotes where the value holds brackets, braces, commas or spaces"
        )
    if isinstance(error, MissingMandatoryValue):
        key = error.full_key
        return f"{key}: this setting has no default; give it as {key}=VALUE"
    text = str(error)
    for pattern, explanation in _EXPLANATIONS:
        match = pattern.search(text)
        if match:
            return explanation(match, name)
    return _joined_lines(text) or type(error).__name__


def _unknown_setting(match: re.Match[str], name: str) -> str:
    setting = match["setting"]
    with settings_folders():
        question = nearest(setting, setting_names(name))
    return f"unknown setting {setting!r}{question}"


def _unknown_option(match: re.Match[str], name: str) -> str:
    option = match["option"]
    available = match["available"].split()
    if not option:
        return f"{match['group']}: choose one of {', '.join(available)}"
    return (
        f"{match['group']}: no such option {option!r}; "
        f"available are {', '.join(available)}{nearest(option, available)}"
    )


def _unknown_target(match: re.Match[str], name: str) -> str:
    return f"_target_: no such class or function {match['target']!r}"


def _list_without_brackets(match: re.Match[str], name: str) -> str:
    key = match["key"]
    explanation = f"{key}: a list is written in brackets, {key}=[{match['values']}]"
    return f"{explanation}; a sweep takes -m" if name == "run" else explanation


# Messages of Hydra, and what says them in the words of this package: a function of the
# match and of the command's settings.
_EXPLANATIONS: tuple[
    tuple[re.Pattern[str], Callable[[re.Match[str], str], str]], ...
] = (
    (re.compile(r"\ACould not override '(?P<setting>[^']+)'"), _unknown_setting),
    (
        re.compile(
            r"Could not find '(?P<group>[^'/]+)/(?P<option>[^']*)'\s+"
            r"Available options in '[^']+':\n(?P<available>(?:\t.*\n)+)"
        ),
        _unknown_option,
    ),
    (re.compile(r"\AError locating target '(?P<target>[^']+)'"), _unknown_target),
    (
        re.compile(
            r"\AAmbiguous value for argument '(?P<key>[^=]+)=(?P<values>[^']+)'"
        ),
        _list_without_brackets,
    ),
)


def _joined_lines(text: str) -> str:
    """Returns a message of several lines in one, without links to Hydra's pages."""
    lines = [line.strip() for line in text.splitlines() if "hydra.cc" not in line]
    return "; ".join(line.rstrip(".:;") for line in lines if line)


def own_error(error: BaseException | None) -> GpmpcError | None:
    """Returns the error of this package that another one is, or was raised from."""
    while error is not None and not isinstance(error, GpmpcError):
        error = error.__cause__
    return error


def one_line(error: BaseException) -> str:
    """Returns the reason of an error in one line."""
    ours = own_error(error)
    reason = f"{type(error).__name__}: {error}" if ours is None else str(ours)
    return " ".join(reason.split())
