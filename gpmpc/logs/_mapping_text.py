"""Reads the YAML text of a mapping; what would take for ever is refused."""

import re
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from gpmpc.exceptions import SettingError

_LONGEST = 2**16  # of a mapping's text [characters]
_NAME_OF_DIGITS = re.compile(r"0[0-9a-zA-Z].*")  # such as 0x1A and 010
_DEEPEST = 10  # levels of a mapping's text


def load_mapping_text(path: str | Path) -> Any:
    """Reads a YAML file as plain data.

    Raises:
        SettingError: The file cannot be read, has a key twice, or its structure is
            such that it would take for ever.
    """
    try:
        with Path(path).open(encoding="utf-8") as file:
            text = file.read(_LONGEST + 1)
        if len(text) > _LONGEST:
            raise SettingError("mapping", f"{path} has more than {_LONGEST} characters")
        _check_structure(text)
        return yaml.load(text, Loader=_UniqueKeys)
    except SettingError:
        raise
    except (
        OSError,
        ValueError,  # of numbers and dates that are none
        RecursionError,
        yaml.YAMLError,
    ) as error:
        name = " ".join(str(path).split())
        reason = " ".join(_reason(error).split())
        raise SettingError(
            "mapping", f"{name:.200} cannot be read ({reason:.300})"
        ) from error


def _reason(error: Exception) -> str:
    """Returns why a file cannot be read, in the words that say it shortest."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        place = error.problem_mark
        return f"line {place.line + 1}, column {place.column + 1}: {error.problem}"
    return str(error)


class _UniqueKeys(yaml.SafeLoader):
    """Reads YAML in which no mapping has a key twice, of which the last would win.

    Digits after a zero are a text: 0x1A is the name of a message on a CAN bus, and no
    column by its number.
    """

    def construct_number(self, node: Any) -> int | str:
        text = str(self.construct_scalar(node))
        return (
            text if _NAME_OF_DIGITS.fullmatch(text) else self.construct_yaml_int(node)
        )

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        content = super().construct_mapping(node, deep)
        if len(content) < len(node.value):
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            key, _ = Counter(keys).most_common(1)[0]
            raise SettingError("mapping", f"holds the key {key!r:.80} twice")
        return content


_UniqueKeys.add_constructor("tag:yaml.org,2002:int", _UniqueKeys.construct_number)


def _check_structure(text: str) -> None:
    """Raises ``SettingError`` of YAML that takes for ever, though it is short.

    A few aliases of aliases stand for more than any memory holds, and the time of
    nested brackets grows with the square of their depth.
    """
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise SettingError(
                "mapping",
                f"has an alias, *{event.anchor}; write out what it stands for",
            )
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise SettingError("mapping", f"is nested deeper than {_DEEPEST} levels")
