"""Reads the words SETTING=VALUE of a command, each once.

word       ``data.size=50``, as it was typed
override   a word as Hydra reads it: key, value, and what it does
choices    the overrides of a run that a result depends on; they name its folder
options    the file that was chosen of each group, such as ``lqr`` of controller
settings   all of a run, composed of the files and the overrides
"""

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser

from gpmpc.cli._plain_settings import ASIDE
from gpmpc.exceptions import SettingError

# Hydra's parser reads such a word as it stands; it takes a tenth of a millisecond.
_WHOLE_NUMBER = re.compile(r"([a-z_][\w.]*)=(0|-?[1-9][0-9]{0,17})", re.ASCII)

_OF_HYDRA = ("hydra.", "hydra/")  # beginnings of the names of Hydra's own settings


@dataclass(frozen=True)
class Override:
    """A word of a command, as Hydra reads it."""

    word: str
    #: with its sign and its package
    key: str
    #: ``key=value`` in Hydra's own spelling; the key alone where it deletes
    choice: str
    value: Any
    #: whether it does no more than to set one value, of a setting that exists
    sets_value: bool

    @property
    def name(self) -> str:
        """The setting or group, without sign and package."""
        return _name_of(self.key)

    @property
    def is_of_hydra(self) -> bool:
        """Whether it is of Hydra's own settings."""
        return self.name.startswith(_OF_HYDRA)

    @property
    def is_aside(self) -> bool:
        """Whether no result depends on it."""
        return is_shared(self.key)

    @property
    def is_word(self) -> bool:
        """Whether it sets a word, such as a group's option, which has no parts."""
        if self.key.startswith("~"):
            return False
        return isinstance(self.value, str) and "${" not in self.value


@lru_cache(maxsize=10_000)
def read_override(word: str) -> Override:
    """Reads one word that is no sweep.

    Raises:
        OverrideParseException: Hydra cannot read it.
    """
    whole_number = _WHOLE_NUMBER.fullmatch(word)
    if whole_number is not None:
        key, digits = whole_number.groups()
        return Override(
            word=word, key=key, choice=word, value=int(digits), sets_value=True
        )
    (parsed,) = OverridesParser.create().parse_overrides([word])
    key = parsed.get_key_element()
    choice = key
    if not parsed.is_delete():
        choice += f"={parsed.get_value_element_as_str()}"
    value = parsed.value()
    has_sign = parsed.is_delete() or parsed.is_add() or parsed.is_force_add()
    merges = isinstance(value, dict)
    return Override(
        word=word,
        key=key,
        choice=choice,
        value=value,
        sets_value=not has_sign and not merges and parsed.package is None,
    )


def is_shared(key: str) -> bool:
    """Whether all runs of a sweep have the same value of a setting, signs aside."""
    name = _name_of(key)
    return name in ASIDE or name.startswith(_OF_HYDRA)


def _name_of(key: str) -> str:
    """Returns the setting or group of a key, without its sign and its package."""
    return key.lstrip("+~").partition("@")[0]


def choices(overrides: Iterable[str]) -> list[str]:
    """Returns what distinguishes a run, ``key=value`` each in Hydra's own spelling.

    They name its folder, and are the ``choices`` of its results.
    Of a key given twice, the last counts. They are sorted, unless one changes a part
    of another: then a command needs their order.
    """
    by_key: dict[str, Override] = {}
    for word in overrides:
        override = read_override(word)
        if not override.is_aside:
            by_key.pop(override.key, None)  # it stands where it was given last
            by_key[override.key] = override
    own_choices = [override.choice for override in by_key.values()]
    if _order_counts([*by_key.values()]):
        return own_choices
    return sorted(own_choices)


def _order_counts(overrides: Sequence[Override]) -> bool:
    """Whether one of some overrides changes what another one sets, or a part of it.

    A value in a group whose option is chosen needs no order: Hydra takes groups first.
    """
    names = [override.name for override in overrides]
    if len({*names}) < len(names):
        return True
    with_parts = {override.name for override in overrides if not override.is_word}
    for name in names:
        *outer, _ = name.split(".")
        if any(".".join(outer[: i + 1]) in with_parts for i in range(len(outer))):
            return True
    return False


def folder_choice(overrides: Iterable[str]) -> list[str]:
    """Returns ``folder=TREE`` where overrides name a tree: no choice, but a place."""
    chosen = [
        override.choice
        for override in map(read_override, overrides)
        if override.name == "folder"
    ]
    return chosen[-1:]


def combinations(overrides: Sequence[str]) -> Iterator[list[str]]:
    """Returns the overrides of every run of a sweep, one run after another.

    Of a key given twice, the last one counts.

    Raises:
        SettingError: A setting has no value to sweep over, or several, and is one that
            all runs share.
    """
    by_key: dict[str, list[str]] = {}
    hydra = GlobalHydra.instance()
    # knows the options that glob(*) stands for
    loader = hydra.config_loader() if hydra.is_initialized() else None
    for override in OverridesParser.create(loader).parse_overrides([*overrides]):
        key = override.get_key_element()
        by_key.pop(key, None)  # it stands where it was given last
        if not override.is_sweep_override():
            by_key[key] = [str(override.input_line)]
            continue
        values = [*override.sweep_string_iterator()]
        if not values:
            raise SettingError(key, "holds no value to sweep over")
        if is_shared(key) and len(values) > 1:
            got = ", ".join(map(str, values))
            raise SettingError(key, f"is one for all runs of a sweep; got {got}")
        by_key[key] = [f"{key}={value}" for value in values]
    return map(list, itertools.product(*by_key.values()))
