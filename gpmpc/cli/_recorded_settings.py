"""Reads the settings out of a recording; refused are those that call anything else.

Settings that a user gives are a program: ``_target_`` calls whatever it names. A
recording may come from anywhere, so its settings are data. They are plain YAML without
aliases, tags and interpolations. Every ``_target_`` in them, at every depth, is
compared with the list in ``gpmpc._trust`` before the first call; and arguments through
which a listed function would import a module, or a solver write a file, are held to the
same rule.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml
from omegaconf import OmegaConf

from gpmpc._trust import (
    LOOKUPS,
    SETTINGS_CODE,
    is_trusted,
    may_be_trusted,
    package_of,
    shipped_name,
    trusted_code,
)
from gpmpc.exceptions import DataError

# Of all settings; those of a flight have about 3000.
_MOST_CHARACTERS = 2**16
_MOST_ENTRY_CHARACTERS = 5000
# An entry is a value, a list or a dictionary; a flight has about 200.
_MOST_ENTRIES = 4000
_MOST_LEVELS = 20  # lists and dictionaries inside each other
_MARKS = ("_target_", "_partial_", "_args_", "_recursive_", "_convert_")
_LOAD = "gpmpc.logs.load_flyable"


def read_settings(text: str) -> dict[str, Any]:
    """Reads settings in YAML as plain data, in bounded time and memory.

    Raises:
        DataError: They are no YAML of names and values, too long or too deep, or hold
            an alias, a tag or an interpolation.
    """
    if len(text) > _MOST_CHARACTERS:
        raise DataError(f"its settings are longer than {_MOST_CHARACTERS} characters")
    try:
        _check_yaml(text)
        settings = OmegaConf.to_container(OmegaConf.create(text))
    except DataError:
        raise
    except Exception as error:  # of the parser, or of a number that Python refuses
        reason = " ".join(str(error).split())
        raise DataError(f"its settings cannot be read ({reason:.200})") from error
    if not isinstance(settings, dict):
        raise DataError("its settings are no names with values")
    return {str(key): value for key, value in settings.items()}


def _check_yaml(text: str) -> None:
    """Raises ``DataError`` of more than plain data, before anything is made of it."""
    depth = entries = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        entries += isinstance(event, yaml.NodeEvent)
        if entries > _MOST_ENTRIES:
            raise DataError(f"its settings hold more than {_MOST_ENTRIES} entries")
        if isinstance(event, yaml.AliasEvent):
            raise DataError("its settings hold a YAML alias, which no flight's do")
        if getattr(event, "tag", None) is not None:
            raise DataError("its settings hold a YAML tag, which no flight's do")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.ScalarEvent):
            if "${" in event.value:
                raise DataError(
                    "its settings hold an interpolation, ${...}; those of a flight are "
                    "resolved"
                )
            if len(event.value) > _MOST_ENTRY_CHARACTERS:
                raise DataError(
                    "its settings hold an entry of more than "
                    f"{_MOST_ENTRY_CHARACTERS} characters"
                )
        if depth > _MOST_LEVELS:
            raise DataError(
                f"its settings are nested deeper than {_MOST_LEVELS} levels"
            )


def checked_settings(settings: Any, trusted: Sequence[str]) -> Any:
    """Returns settings out of a file, as a copy, if all that they call may be called.

    Args:
        settings: Plain data, merged to what will be called.
        trusted: Names of packages whose code they may call besides. Saved models that
            they name are loaded with the same trust, whatever the file says.

    Raises:
        DataError: They call something else, and nothing was imported; or a trusted
            package has no such code.
    """
    checked = _with_trust(settings, trusted)
    calls = [*_calls(checked, "")]
    for call in calls:
        _check_form(call)
        _check_name(call, trusted)
        _check_arguments(call, call.code, trusted)
    # Every name is allowed: trusted packages may be imported now, which tells what
    # names of theirs stand for. ``my_robot.Solver`` may be a listed function's alias,
    # whose arguments have to be checked as well.
    for call in calls:
        if call.code not in SETTINGS_CODE:
            alias = shipped_name(trusted_code(call.code, trusted))
            _check_arguments(call, alias, trusted)
    return checked


@dataclass(frozen=True)
class _Call:
    """A dictionary of settings that calls a function or a class."""

    place: str  #: where it stands, dotted
    settings: Mapping[str, Any]  #: all that stands in it

    @property
    def code(self) -> Any:
        """The name of what is called, or of what Hydra looks up by its path."""
        target = self.settings["_target_"]
        return self.settings.get("path") if target in LOOKUPS else target


def _with_trust(node: Any, trusted: Sequence[str]) -> Any:
    """Copies plain settings; saved models in them get a caller's trust."""
    if isinstance(node, list):
        return [_with_trust(entry, trusted) for entry in node]
    if not isinstance(node, dict):
        return node
    copied = {key: _with_trust(value, trusted) for key, value in node.items()}
    if copied.get("_target_") == _LOAD:
        copied["trusted"] = list(trusted)
    return copied


def _calls(node: Any, place: str) -> Iterator[_Call]:
    """Yields every call in settings, at every depth."""
    if isinstance(node, list):
        for index, entry in enumerate(node):
            yield from _calls(entry, f"{place}[{index}]")
    if not isinstance(node, dict):
        return
    if "_target_" in node:
        yield _Call(place, node)
    for key, value in node.items():
        if str(key).startswith("_") and key not in _MARKS:
            raise DataError(
                f"its settings hold {_dotted(place, key)}, which means nothing"
            )
        yield from _calls(value, _dotted(place, key))


def _dotted(place: str, key: Any) -> str:
    """Returns the place of a key, dotted."""
    dotted = f"{place}.{key}".lstrip(".")
    return dotted if dotted.isprintable() else repr(dotted)


def _check_form(call: _Call) -> None:
    """Raises ``DataError`` where a call is not written as Hydra reads one."""
    settings = call.settings
    place = call.place
    if not isinstance(settings["_target_"], str) or not isinstance(call.code, str):
        raise DataError(f"its settings name nothing at {_dotted(place, '_target_')}")
    if settings["_target_"] in LOOKUPS and {*settings} != {"_target_", "path"}:
        raise DataError(f"its settings look code up in another way at {place}")
    for key in ("_partial_", "_recursive_"):
        if not isinstance(settings.get(key, True), bool):
            raise DataError(f"{_dotted(place, key)}: must be true or false")
    if settings.get("_convert_", "all") not in ("none", "partial", "object", "all"):
        raise DataError(f"{_dotted(place, '_convert_')}: must be a word of Hydra's")
    if not isinstance(settings.get("_args_", []), list):
        raise DataError(f"{_dotted(place, '_args_')}: must be a list")


def _check_name(call: _Call, trusted: Sequence[str]) -> None:
    """Raises ``DataError`` unless what is called is listed, or trusted."""
    name = call.code
    package = package_of(call.code)
    if name in SETTINGS_CODE or is_trusted(name, trusted):
        return
    named = f"its settings call {name!r:.100} ({_dotted(call.place, '_target_')})"
    if is_trusted(name, [package]) and may_be_trusted(package):
        raise DataError(f"{named}, {_remedy(package)}")
    raise DataError(f"{named}, which no settings in a file may call")


def _remedy(package: str) -> str:
    return (
        f"code of {package} and not of gpmpc: "
        f"if you trust the file as you do a script, --trust {package}"
    )


def _check_arguments(call: _Call, name: str | None, trusted: Sequence[str]) -> None:
    """Raises ``DataError`` where a listed function would import a module or write."""
    check = _ARGUMENTS.get(name or "")
    if check is None:
        return
    if "_args_" in call.settings:
        place = _dotted(call.place, "_args_")
        raise DataError(f"{place}: give arguments by their names")
    check(call, trusted)


def _check_environment(call: _Call, trusted: Sequence[str]) -> None:
    """Raises where gymnasium would import a module, or hand text to an environment.

    It imports the module in ``module:name``; a text may be a file to be opened.
    """
    environment = call.settings.get("environment")
    if isinstance(environment, str) and ":" in environment:
        module = environment.partition(":")[0]
        if not is_trusted(module, trusted):
            place = _dotted(call.place, "environment")
            raise DataError(
                f"its settings import {module!r:.100} ({place}), "
                f"{_remedy(package_of(module))}"
            )
    if _holds_text(call.settings.get("make")) and not is_trusted("gymnasium", trusted):
        place = _dotted(call.place, "make")
        raise DataError(
            f"its settings hand text to an environment ({place}), "
            f"{_remedy('gymnasium')}"
        )


def _check_options(call: _Call, trusted: Sequence[str]) -> None:
    """Raises where options are handed to a solver: some name files to be written."""
    if call.settings.get("options") and not is_trusted("cvxpy", trusted):
        place = _dotted(call.place, "options")
        raise DataError(
            f"its settings hand options to a solver ({place}), {_remedy('cvxpy')}"
        )


def _check_trust(call: _Call, trusted: Sequence[str]) -> None:
    """Raises where a file says whom to trust: that is the caller's to say."""
    packages = call.settings.get("trusted") or []
    is_list = isinstance(packages, list)
    if not is_list or not set(map(str, packages)) <= set(trusted):
        raise DataError(
            f"{_dotted(call.place, 'trusted')}: a file cannot say what is trusted; "
            "--trust PACKAGE does"
        )


def _holds_text(node: Any) -> bool:
    """Tells whether there is text among the values of plain data, at any depth."""
    if isinstance(node, dict):
        return any(map(_holds_text, node.values()))
    if isinstance(node, list):
        return any(map(_holds_text, node))
    return isinstance(node, str)


_ARGUMENTS: dict[str, Callable[[_Call, Sequence[str]], None]] = {
    "gpmpc.systems.gymnasium_.gymnasium_system": _check_environment,
    "gpmpc.qp.CvxpySolver": _check_options,
    "gpmpc.mpc.baselines.StateFormMPC": _check_options,
    _LOAD: _check_trust,
}
