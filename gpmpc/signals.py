"""Names and the time step, by which data, a model and a plant fit together.

None of them is needed: an unknown name or time step fits everything. Where two sides
both know one, theirs have to agree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gpmpc._arrays import plain_names
from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, ShapeError, check_number

__all__ = ["Signals"]

SAME_STEP = 1e-3  # relative difference of two time steps that are the same: a log's are


@explains_arguments
@dataclass(frozen=True)
class Signals:
    """States and inputs by name, in their order, and the time between two samples.

    Columns of our own recordings are named without their topic, ``x`` for ``state.x``.

    >>> Signals(["angle", "rate"], ["torque"], 0.05).state_names
    ('angle', 'rate')

    Raises:
        SettingError: Names that are no different texts, or a time step that is not
            positive.
    """

    state_names: Sequence[str] = ()  #: of the n states; empty where they are not known
    input_names: Sequence[str] = ()  #: of the m inputs; likewise
    time_step: float | None = None  #: [s]; None where it is not known

    def __post_init__(self) -> None:
        for key in ("state_names", "input_names"):
            names = getattr(self, key)
            listed = isinstance(names, Sequence) and not isinstance(names, str)
            if (
                not listed
                or not all(isinstance(name, str) for name in names)
                or len(set(names)) < len(names)
            ):
                raise SettingError(
                    key, f"must be a list of different names; got {names!r}"
                )
            object.__setattr__(self, key, plain_names(names))
        if self.time_step is not None:
            check_number("time_step", self.time_step, above=0, unit="[s]")
            # files hold no NumPy numbers
            object.__setattr__(self, "time_step", float(self.time_step))

    def check_sizes(self, states: int, inputs: int) -> None:
        """Raises ``ShapeError`` where it names another number of states or inputs."""
        for what, names, count in (
            ("states", self.state_names, states),
            ("inputs", self.input_names, inputs),
        ):
            if names and len(names) != count:
                named = ", ".join(names)
                raise ShapeError(f"{count} {what} need as many names; got {named}")

    def check(
        self, owner: str, other: "Signals", other_owner: str, key: str = "signals"
    ) -> None:
        """Raises ``SettingError`` where names or time step of two owners differ.

        Args:
            owner: Whose these are, as the message calls it.
            other: The others.
            other_owner: Whose those are.
            key: The setting that the error names.
        """
        if self is other or self == other:
            return
        for what, ours, theirs in (
            ("states", self.state_names, other.state_names),
            ("inputs", self.input_names, other.input_names),
        ):
            if ours and theirs and ours != theirs:
                same = ", the same in another order" * (set(ours) == set(theirs))
                raise SettingError(
                    key,
                    f"{owner} has the {what} {', '.join(ours)}; "
                    f"{other_owner} has {', '.join(theirs)}{same}",
                )
        ours = self.time_step
        theirs = other.time_step
        if ours and theirs and abs(ours / theirs - 1) > SAME_STEP:
            raise SettingError(
                key,
                f"{owner} has time steps of {ours:g} s; {other_owner} has {theirs:g} s",
            )

    def to_header(self) -> dict[str, Any]:
        """Returns the known values as data that JSON can hold, for a file's header."""
        header: dict[str, Any] = {}
        for key, value in vars(self).items():
            if value:
                header[key] = list(value) if isinstance(value, tuple) else value
        return header

    @classmethod
    def from_header(cls, header: Any) -> "Signals":
        """Reads the result of ``to_header``; None is the header of unknown signals.

        Raises:
            SettingError: It is something else.
        """
        if header is None:
            return cls()
        keys = {"state_names", "input_names", "time_step"}
        if not isinstance(header, Mapping) or not header.keys() <= keys:
            rule = "must be names and a time step"
            raise SettingError("signals", f"{rule}; got {header!r}")
        return cls(**header)


UNKNOWN = Signals()


def signals_of(owner: Any) -> Signals:
    """Returns the names and the time step of a model, a controller, data or a plant.

    They are unknown of one without such an attribute ``signals``.
    """
    signals = getattr(owner, "signals", UNKNOWN)
    return signals if isinstance(signals, Signals) else UNKNOWN


def check_signals(value: Any) -> None:
    """Raises ``SettingError`` unless this is a ``Signals``."""
    if not isinstance(value, Signals):
        raise SettingError(
            "signals", f"must be Signals(...); got {type(value).__name__}"
        )
