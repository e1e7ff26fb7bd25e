"""Says which system with named parameters a mapping takes for its nominal model."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpmpc._trust import SYSTEM_CODE, may_be_trusted, package_of
from gpmpc.exceptions import SettingError, check_number
from gpmpc.models._system_nominal import FittedParameter

_KEYS = ("system", "parameters", "fixed")
_PARAMETER_KEYS = ("start", "low", "high")
_CODE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


@dataclass(frozen=True)
class NominalSystem:
    """A class or function that makes a system of parameters, by its name.

    Raises:
        SettingError: It is no name of code that may be called.
    """

    code: str  #: such as "my_robot:Arm"
    #: those that are fitted; none for all of its arguments that are numbers
    parameters: tuple[FittedParameter, ...] = ()
    bounded: tuple[str, ...] = ()  #: parameters whose bounds are given
    fixed: dict[str, Any] = field(default_factory=dict)  #: its other arguments

    def __post_init__(self) -> None:
        if not _CODE.fullmatch(self.code):
            raise SettingError(
                "nominal", f"must be such as my_robot:Arm; got {self.code!r:.100}"
            )
        if self.code not in SYSTEM_CODE and not may_be_trusted(package_of(self.code)):
            own = ", ".join(sorted(SYSTEM_CODE))
            raise SettingError(
                "nominal",
                f"{self.code} makes no system; of gpmpc itself there are {own}",
            )

    @classmethod
    def from_plain(cls, content: Any) -> "NominalSystem":
        """Makes it of plain data, as a YAML file holds them."""
        if isinstance(content, str):
            content = {"system": content}
        _check_keys("nominal", content, _KEYS)
        code = content.get("system")
        if not isinstance(code, str):
            raise SettingError(
                "nominal.system", f"must be such as my_robot:Arm; got {code!r:.100}"
            )
        if ":" not in code:
            module, _, name = code.rpartition(".")
            code = f"{module}:{name}"
        entries = content.get("parameters") or {}
        _check_keys("nominal.parameters", entries, None)
        parameters = [_read_parameter(*item) for item in entries.items()]
        fixed = content.get("fixed") or {}
        _check_keys("nominal.fixed", fixed, None)
        bounded = [
            str(name)
            for name, entry in entries.items()
            if isinstance(entry, Mapping) and {"low", "high"} & {*entry}
        ]
        return cls(code, tuple(parameters), tuple(bounded), dict(fixed))


def _read_parameter(name: Any, entry: Any) -> FittedParameter:
    """Reads a parameter: the number at which a fit begins, or that with bounds."""
    key = f"nominal.parameters.{name}"
    if not isinstance(entry, Mapping):
        entry = {"start": entry}
    _check_keys(key, entry, _PARAMETER_KEYS)
    if "start" not in entry:
        raise SettingError(f"{key}.start", "must be given: where the fit begins")
    for end, value in entry.items():
        check_number(f"{key}.{end}", value)
    return FittedParameter(
        name=str(name),
        start=float(entry["start"]),
        low=float(entry.get("low", -np.inf)),
        high=float(entry.get("high", np.inf)),
    )


def _check_keys(key: str, content: Any, known: tuple[str, ...] | None) -> None:
    """Raises ``SettingError`` of what is no mapping, or has other keys than known."""
    if not isinstance(content, Mapping):
        raise SettingError(key, f"must be keys and values; got {content!r:.200}")
    unknown = [name for name in content if known is not None and name not in known]
    if unknown:
        raise SettingError(
            f"{key}.{unknown[0]}", f"no such key; known are {', '.join(known or ())}"
        )
