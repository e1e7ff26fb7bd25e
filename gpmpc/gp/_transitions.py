"""Observed transitions (x[k], u[k]) -> x[k+1], the data of a dynamics model.

They come from arrays, an ``.npz`` file, a CSV file with named columns, or the text format in which Cao, Lai and Alam
published their data, and are finite float64 of matching shapes; errors name file, row and column.
Names and time step stand with them where they are known: tables of pandas and CSV files have names.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import state_difference
from gpmpc._arrays import labels_of, names_of, order_of, read_array
from gpmpc._files import existing_file, new_file, write_whole
from gpmpc.exceptions import (
    DataError,
    GpmpcError,
    SettingError,
    ShapeError,
    UnsupportedModel,
    check_number,
)
from gpmpc.gp._storage import consistent, read_npz, write_npz
from gpmpc.signals import UNKNOWN, Signals, check_signals, signals_of

_NAMES = ("states", "inputs", "next_states")
_EXPECTED = "a file of transitions"


@dataclass(frozen=True)
class Transitions:
    """N observed transitions of a system with n states and m inputs, as float64.

    Columns of tables are sorted by name, next states like the states: by the same names,
    or by these with one prefix or suffix (``next_angle``, ``next_rate``).

    Raises:
        ShapeError: The three do not belong together, there is no row, or there are not
            as many names as columns.
        DataError: An entry is not finite (its row and column are named, from 1), or no
            number; or a table has other columns than its names say.

    >>> data = Transitions(states=[[0.0], [1.0]], inputs=[[0.5], [0.5]], next_states=[[1.0], [2.0]])
    >>> len(data), data[1:].states.tolist()
    (2, [[1.0]])
    """

    states: Tensor  #: x[k], (N, n)
    inputs: Tensor  #: u[k], (N, m); m may be zero
    next_states: Tensor  #: x[k+1], (N, n)
    #: names and time step, where they are known; those of tables' columns by default
    signals: Signals = UNKNOWN

    if TYPE_CHECKING:  # anything that is an array of numbers

        def __init__(
            self,
            states: Any,
            inputs: Any,
            next_states: Any,
            signals: Signals = UNKNOWN,
        ) -> None: ...

    def __post_init__(self) -> None:
        check_signals(self.signals)
        signals = Signals(
            self.signals.state_names or names_of(self.states),
            self.signals.input_names or names_of(self.inputs),
            self.signals.time_step,
        )
        tables = {
            "states": _real("states", self.states, signals.state_names),
            "inputs": _real("inputs", self.inputs, signals.input_names),
            "next_states": _real_next(self.next_states, self.states, signals),
        }
        object.__setattr__(self, "signals", signals)
        for name, value in tables.items():
            if value.dim() != 2:
                raise ShapeError(
                    f"{name} must have two dimensions (rows, columns); got shape {tuple(value.shape)}"
                )
            for row, column in torch.nonzero(~torch.isfinite(value))[:1].tolist():
                got = (
                    f"{float(value[row, column])} in row {row + 1}, column {column + 1}"
                )
                raise DataError(f"{name} must be finite; got {got}")
            object.__setattr__(self, name, value)
        x, u, after = (tuple(getattr(self, name).shape) for name in _NAMES)
        if x != after or x[0] != u[0] or not x[0]:
            rule = "states (N, n), inputs (N, m), next_states (N, n) need the same n and number N of rows, one or more"
            raise ShapeError(f"{rule}; got {x}, {u} and {after}")
        signals.check_sizes(self.state_dim, self.input_dim)

    def __len__(self) -> int:
        return len(self.states)

    def __repr__(self) -> str:
        return f"Transitions({len(self)} rows, n={self.state_dim}, m={self.input_dim})"

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return self.states.shape[1]

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.inputs.shape[1]

    @property
    def features(self) -> Tensor:
        """x~ = (x, u), (N, n + m)."""
        return torch.cat([self.states, self.inputs], dim=1)

    def targets(self, predicts: str, angles: Sequence[int] = ()) -> Tensor:
        """What GPs that predict ``"next_state"`` or ``"difference"`` learn of them (N, n).

        Differences of ``angles``, indices of states in rad, are taken within half a turn: a sensor may wrap them.

        Raises:
            UnsupportedModel: They predict values, which transitions do not hold.
        """
        if predicts == "value":
            raise UnsupportedModel(
                "transitions hold no targets of GPs with predicts='value': use append_points, "
                "or fit(features, targets, ...) of a trainer"
            )
        if predicts == "difference":
            return state_difference(self.next_states, self.states, angles)
        return self.next_states

    def __getitem__(self, rows: slice | Sequence[int]) -> "Transitions":
        """The transitions of some rows, in the order given."""
        return Transitions(
            self.states[rows], self.inputs[rows], self.next_states[rows], self.signals
        )

    def save(self, path: str | Path) -> None:
        """Writes an uncompressed ``.npz`` (no pickle), in one piece or not at all."""
        arrays = {name: getattr(self, name).numpy(force=True) for name in _NAMES}
        header: dict[str, Any] = {"format": "gpmpc transitions", "format_version": 1}
        header["signals"] = self.signals.to_header()
        write_whole(new_file(path), write_npz(header, arrays))

    @classmethod
    def load(cls, path: str | Path) -> "Transitions":
        """Reads what ``save`` wrote, or NumPy's ``savez`` of arrays with the same names.

        Raises:
            DataError: The file is missing, damaged, or not such a file.
        """
        path = existing_file(path, _EXPECTED)
        with consistent(path, "not a readable .npz file of transitions"):
            header, arrays = read_npz(path, _NAMES)
            stated = header.get("signals") if isinstance(header, dict) else None
            signals = Signals.from_header(stated)
        missing = [name for name in _NAMES if name not in arrays]
        if missing:
            raise DataError(
                f"{path}: array {missing[0]!r} is missing; expected {', '.join(_NAMES)}"
            )
        if not arrays["states"].size:
            raise DataError(f"{path}: holds no states")
        states, inputs, next_states = (arrays[name] for name in _NAMES)
        return _with_path(path, states, inputs, next_states, signals)

    @classmethod
    def from_text(
        cls, path: str | Path, state_dim: int = 6, input_dim: int = 3
    ) -> "Transitions":
        """Reads blank-separated columns x[k] (n), u[k] (m), x[k+1] (n), the format of Cao, Lai and Alam's data.

        Raises:
            DataError: The file is missing, a row has another number of columns, or an entry is no finite number.
        """
        check_number("state_dim", state_dim, least=1, whole=True)
        check_number("input_dim", input_dim, least=0, whole=True)
        n = state_dim
        width = 2 * state_dim + input_dim
        lines = enumerate(map(str.split, _text(path).splitlines()), start=1)
        table = _table(
            path, lines, {number: number - 1 for number in range(1, width + 1)}, width
        )
        return _with_path(path, table[:, :n], table[:, n:-n], table[:, -n:])

    @classmethod
    def from_csv(
        cls,
        path: str | Path,
        states: Sequence[str],
        inputs: Sequence[str],
        next_states: Sequence[str] | None = None,
        time_step: float | None = None,
    ) -> "Transitions":
        """Reads named columns of a CSV file with a header line.

        Args:
            path: The file; separated by commas, or by semicolons or tabs where the header has them.
            states: Names of the columns x[k].
            inputs: Names of the columns u[k].
            next_states: Names of the columns x[k+1], sorted as the states where they are
                the states' names with a prefix or suffix. ``None`` takes the file for
                one recording at equal time steps: the next row's states are the next
                states, and the last row only serves as such.
            time_step: Between the two states of a row [s], where it is known.

        Raises:
            SettingError: One name was given where a list of them belongs.
            DataError: The file or a column is missing, or an entry is no finite number.
        """
        for key, names in (
            ("states", states),
            ("inputs", inputs),
            ("next_states", next_states or ()),
        ):
            if isinstance(names, str) or not isinstance(names, Iterable):
                raise SettingError(
                    key, f"must be a list of column names; got {names!r}"
                )
        states = list(states)
        inputs = list(inputs)
        next_states = None if next_states is None else list(next_states)
        if not states:
            raise SettingError("states", "must name a column; got none")
        text = _text(path)
        reader = csv.reader(
            io.StringIO(text), delimiter=max(",;\t", key=text.partition("\n")[0].count)
        )
        try:
            (_, header), *lines = [(reader.line_num, fields) for fields in reader] or [
                (1, [])
            ]
        except csv.Error as error:
            raise DataError(
                f"{path}: row {reader.line_num} cannot be read ({error})"
            ) from error
        header = [name.strip() for name in header]
        wanted = [*states, *inputs, *(next_states or ())]
        for name in wanted:
            if header.count(name) != 1:
                problem = "stands there twice" if name in header else "is missing"
                raise DataError(
                    f"{path}: column {name!r} {problem}; the header has {', '.join(header) or 'no columns'}"
                )
        places = {name: header.index(name) for name in wanted}
        table = _table(path, lines, places, len(header), least=1 if next_states else 2)
        signals = Signals(list(states), list(inputs), time_step)
        column = list(places).index
        x, u, after = (
            table[:, list(map(column, part))]
            for part in (states, inputs, next_states or states)
        )
        if next_states:
            named = _without_affixes(list(next_states), signals.state_names)
            order = order_of(named, signals.state_names)
            after = after if order is None else after[:, order]
            return _with_path(path, x, u, after, signals)
        return _with_path(path, x[:-1], u[:-1], after[1:], signals)


def check_transitions(transitions: Any, model: Any = None) -> None:
    """Raises unless these are transitions, of as many states and inputs as a model, where one is given, has."""
    if not isinstance(transitions, Transitions):
        raise SettingError(
            "transitions", f"must be Transitions(...); got {type(transitions).__name__}"
        )
    n = transitions.state_dim
    m = transitions.input_dim
    if model is not None and (n, m) != (model.state_dim, model.input_dim):
        rule = f"the model has {model.state_dim} states and {model.input_dim} inputs"
        raise ShapeError(f"{rule}; got transitions with {n} and {m}")
    if model is not None:
        signals_of(model).check("the model", transitions.signals, "transitions")


def _real(key: str, values: Any, names: Sequence[str] = ()) -> Tensor:
    """A table of numbers as float64, its columns in the order of the names."""
    real = isinstance(values, Tensor) and values.dtype != torch.bool
    if real and not (values.is_complex() or values.requires_grad):
        return values.to(torch.float64)
    rule = "must be numbers in rows and columns"
    return torch.from_numpy(np.array(read_array(key, values, names, rule)))


def _real_next(values: Any, states: Any, signals: Signals) -> Tensor:
    """Next states as float64, whose columns stand in the order of the states'.

    Raises:
        DataError: Both are tables, and no column says which state it belongs to.
    """
    ours = signals.state_names or labels_of(states)
    labels = labels_of(values)
    table = _real("next_states", values)
    if not labels or not ours:
        return table
    order = order_of(_without_affixes(labels, ours), ours)
    if order is not None and table.dim() == 2:
        return table[:, order]
    if not (names_of(values) and signals.state_names):  # numbers of columns say nothing
        return table
    rule = "next_states must have the columns of the states, or these with one prefix"
    raise DataError(
        f"{rule} or suffix; got {', '.join(labels)}, states {', '.join(ours)}"
    )


def _without_affixes(labels: Sequence[Any], names: Sequence[Any]) -> Sequence[Any]:
    """The names in labels that are these between one prefix and one suffix."""
    if not all(isinstance(label, str) for label in (*labels, *names)):
        return labels
    for name in names:
        prefix, found, suffix = labels[0].partition(name)
        if found and {f"{prefix}{each}{suffix}" for each in names} == set(labels):
            return [label.removeprefix(prefix).removesuffix(suffix) for label in labels]
    return labels


def _text(path: str | Path) -> str:
    path = existing_file(path, _EXPECTED)
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a readable text file ({error})") from error


def _table(
    path: str | Path,
    lines: Iterable[tuple[int, list[str]]],
    columns: Mapping[Any, int],
    width: int,
    least: int = 1,
) -> np.ndarray:
    """The numbers in the columns, at the places by their names, of ``least`` or more lines that are not empty."""
    rows = []
    for line, fields in lines:
        if fields and len(fields) != width:
            raise DataError(
                f"{path}: row {line} has {len(fields)} columns; expected {width}"
            )
        if fields:
            rows.append(
                [
                    _number(path, line, name, fields[place])
                    for name, place in columns.items()
                ]
            )
    if len(rows) < least:
        raise DataError(
            f"{path}: the file holds {len(rows)} rows; expected {least} or more, of {width} columns"
        )
    return np.array(rows)


def _number(path: str | Path, row: int, column: int | str, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or "_" in field:  # Python takes 1_0 for 10
        raise DataError(
            f"{path}: row {row}, column {column} is {field.strip()!r}; expected a finite number"
        )
    return value


def _with_path(
    path: str | Path,
    states: Any,
    inputs: Any,
    next_states: Any,
    signals: Signals = UNKNOWN,
) -> Transitions:
    try:
        return Transitions(states, inputs, next_states, signals)
    except GpmpcError as error:
        raise DataError(f"{path}: {error}") from error
