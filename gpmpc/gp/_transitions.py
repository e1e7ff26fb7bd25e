"""Observed transitions (x[k], u[k]) -> x[k+1], the data of a dynamics model.

They come from arrays, an ``.npz`` file, a CSV file with named columns, or the text
format in which Cao, Lai and Alam published their data, and are finite float64 of
matching shapes; errors name file, row and column. Names and time step stand with them
where they are known: tables of pandas and CSV files have names.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import state_difference
from gpmpc._arrays import labels_of, names_of, order_of, read_array
from gpmpc._calls import explains_arguments
from gpmpc._files import existing_file, new_file, write_whole
from gpmpc.exceptions import (
    DataError,
    GpmpcError,
    SettingError,
    ShapeError,
    UnsupportedModel,
    check_choice,
    check_number,
)
from gpmpc.gp._storage import brief, consistent, read_npz, write_npz
from gpmpc.gp._tensor_checks import PREDICTS, check_on_host
from gpmpc.signals import UNKNOWN, Signals, check_signals, signals_of

_NAMES = ("states", "inputs", "next_states")
_EXPECTED = "a file of transitions"
_FORMAT = "gpmpc transitions"
_VERSION = 1  # of the format


@explains_arguments
@dataclass(frozen=True, eq=False)
class Transitions:
    """N observed transitions of a system with n states and m inputs, as float64.

    Columns of tables are sorted by name, next states like the states: by the same
    names, or by these with one prefix or suffix (``next_angle``, ``next_rate``).

    Raises:
        ShapeError: The three do not belong together, there is no row, or there are not
            as many names as columns.
        DataError: An entry is not finite (its row and column are named, from 1), or no
            number; or a table has other columns than its names say.

    >>> data = Transitions(
    ...     states=[[0.0], [1.0]], inputs=[[0.5], [0.5]], next_states=[[1.0], [2.0]]
    ... )
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
        signals = signals_of_tables(self.signals, self.states, self.inputs)
        tables = {
            "states": _real("states", self.states, signals.state_names),
            "inputs": _real("inputs", self.inputs, signals.input_names),
            "next_states": _real_next(self.next_states, self.states, signals),
        }
        object.__setattr__(self, "signals", signals)
        for name, value in tables.items():
            if value.dim() != 2:
                raise ShapeError(
                    f"{name} must have two dimensions (rows, columns); "
                    f"got shape {tuple(value.shape)}"
                )
            _check_finite(name, value)
            object.__setattr__(self, name, value)
        x = tuple(self.states.shape)
        u = tuple(self.inputs.shape)
        after = tuple(self.next_states.shape)
        if x != after or x[0] != u[0] or not x[0]:
            raise ShapeError(
                "states (N, n), inputs (N, m), next_states (N, n) need the same n and "
                f"number N of rows, one or more; got {x}, {u} and {after}"
            )
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
        """Returns what GPs learn that predict next states or differences (N, n).

        Differences of ``angles``, indices of states in rad, are taken within half a
        turn: a sensor may wrap them.

        Raises:
            SettingError: ``predicts`` is no such word.
            UnsupportedModel: They predict values, which transitions do not hold.
        """
        check_choice("predicts", predicts, PREDICTS)
        if predicts == "value":
            raise UnsupportedModel(
                "transitions hold no targets of GPs with predicts='value': use "
                "append_points, or fit(features, targets, ...) of a trainer"
            )
        if predicts == "difference":
            return state_difference(self.next_states, self.states, angles)
        return self.next_states

    def __getitem__(self, rows: slice | Sequence[int]) -> "Transitions":
        """Returns the transitions of some rows, in their order."""
        indices = _row_indices(rows, len(self))
        return Transitions(
            self.states[indices],
            self.inputs[indices],
            self.next_states[indices],
            self.signals,
        )

    def save(self, path: str | Path) -> None:
        """Writes an uncompressed ``.npz`` (no pickle), in one piece or not at all."""
        arrays = {name: getattr(self, name).numpy(force=True) for name in _NAMES}
        header: dict[str, Any] = {"format": _FORMAT, "format_version": _VERSION}
        header["signals"] = self.signals.to_header()
        write_whole(new_file(path), write_npz(header, arrays))

    @classmethod
    def load(cls, path: str | Path) -> "Transitions":
        """Reads what ``save`` wrote, or ``numpy.savez`` of arrays with the same names.

        Raises:
            DataError: The file is missing, damaged, of a newer format, or not such a
                file.
        """
        path = existing_file(path, _EXPECTED)
        with consistent(path, "not a readable .npz file of transitions"):
            header, arrays = read_npz(path, _NAMES)
        _check_format(path, header)
        with consistent(path, "not a readable .npz file of transitions"):
            stated = header.get("signals") if isinstance(header, dict) else None
            signals = Signals.from_header(stated)
        missing = [name for name in _NAMES if name not in arrays]
        if missing:
            raise DataError(
                f"{path}: array {missing[0]!r} is missing; expected {', '.join(_NAMES)}"
            )
        if not arrays["states"].size:
            raise DataError(f"{path}: holds no states")
        return _from_file(
            path,
            states=arrays["states"],
            inputs=arrays["inputs"],
            next_states=arrays["next_states"],
            signals=signals,
        )

    @classmethod
    def from_text(
        cls, path: str | Path, state_dim: int = 6, input_dim: int = 3
    ) -> "Transitions":
        """Reads blank-separated columns x[k] (n), u[k] (m), x[k+1] (n).

        That is the format of Cao, Lai and Alam's data.

        Raises:
            DataError: The file is missing, a row has another number of columns, or an
                entry is no finite number.
        """
        check_number("state_dim", state_dim, least=1, whole=True)
        check_number("input_dim", input_dim, least=0, whole=True)
        n = state_dim
        width = 2 * state_dim + input_dim
        lines = enumerate(map(str.split, _text(path).splitlines()), start=1)
        places = {number: number - 1 for number in range(1, width + 1)}
        table = _table(path, lines, places, width)
        return _from_file(
            path,
            states=table[:, :n],
            inputs=table[:, n:-n],
            next_states=table[:, -n:],
        )

    @classmethod
    @explains_arguments
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
            path: The file; separated by commas, or by semicolons or tabs where the
                header has them.
            states: Names of the columns x[k].
            inputs: Names of the columns u[k].
            next_states: Names of the columns x[k+1], sorted as the states where they
                are the states' names with a prefix or suffix. None, or an empty list,
                takes the file for one recording at equal time steps: the next row's
                states are the next states, and the last row only serves as such.
                Empty lines do not count, nor part recordings.
            time_step: Between the two states of a row [s], where it is known.

        Raises:
            SettingError: One name was given where a list of them belongs, or a column
                stands for two states or inputs.
            DataError: The file or a column is missing, an entry is no finite number, or
                the next states are named in another order than the states, with
                affixes of their own each.
        """
        _check_name_list("states", states)
        _check_name_list("inputs", inputs)
        _check_name_list("next_states", next_states or ())
        states = list(states)
        inputs = list(inputs)
        if not states:
            raise SettingError("states", "must name a column; got none")
        is_recording = not next_states
        next_names = list(next_states or states)
        header, lines = _csv_lines(path)
        columns = [*states, *inputs, *next_names]
        for name in inputs:
            if name in states:
                raise SettingError("inputs", f"must be no states; got {name!r}")
        if len(set(next_names)) < len(next_names):
            raise SettingError(
                "next_states", f"must be different columns; got {', '.join(next_names)}"
            )
        _check_header(path, header, columns)
        places = {name: header.index(name) for name in columns}
        table = _table(path, lines, places, len(header), least=2 if is_recording else 1)
        index = {name: i for i, name in enumerate(places)}
        x = table[:, [index[name] for name in states]]
        u = table[:, [index[name] for name in inputs]]
        after = table[:, [index[name] for name in next_names]]
        signals = Signals(states, inputs, time_step)
        if is_recording:
            return _from_file(path, x[:-1], u[:-1], after[1:], signals)
        stems = _without_affixes(next_names, signals.state_names)
        order = order_of(stems, signals.state_names)
        if order is None:
            _check_places(next_names, signals.state_names)
        else:
            after = after[:, order]
        return _from_file(path, x, u, after, signals)


def _row_indices(rows: Any, count: int) -> list[int]:
    """Lists the rows of ``count`` that a slice, whole numbers or a mask choose.

    Raises:
        SettingError: They are something else, or beyond the rows.
    """
    if isinstance(rows, slice):
        return list(range(count)[rows])
    values = rows.numpy(force=True) if isinstance(rows, Tensor) else _array(rows)
    is_mask = values.dtype == bool and values.shape == (count,)
    if is_mask:
        return np.flatnonzero(values).tolist()
    are_indices = values.ndim == 1 and (values.dtype.kind in "iu" or not values.size)
    indices = values.tolist()
    if not are_indices or not all(-count <= i < count for i in indices):
        raise SettingError(
            "rows",
            "must be whole numbers or a slice; columns are in states and inputs; "
            f"got {rows!r:.200} of {count} rows",
        )
    return indices


def _array(values: Any) -> np.ndarray:
    """Returns values as an array; of objects where they are none."""
    try:
        return np.asarray(values)
    except ValueError:  # rows of unequal lengths
        return np.asarray(None)


def _check_format(path: Path, header: Any) -> None:
    """Raises ``DataError`` where a header is that of other files, or of newer ones.

    ``numpy.savez`` writes none.
    """
    if header is None:
        return
    stated = header.get("format") if isinstance(header, dict) else header
    if stated != _FORMAT:
        raise DataError(f"{path}: holds {brief(stated)}; expected {_EXPECTED}")
    version = header.get("format_version")
    if type(version) is not int or not 1 <= version <= _VERSION:
        raise DataError(
            f"{path}: written in format {version!r:.80}; this version reads up to "
            f"{_VERSION}: update gpmpc"
        )


def signals_of_tables(signals: Signals, states: Any, inputs: Any) -> Signals:
    """Returns signals with the names of tables' columns where they have none.

    Raises:
        SettingError: They are no ``Signals``.
    """
    check_signals(signals)
    return Signals(
        state_names=signals.state_names or names_of(states),
        input_names=signals.input_names or names_of(inputs),
        time_step=signals.time_step,
    )


def check_transitions(transitions: Any, model: Any = None) -> None:
    """Raises unless these are transitions, and fit a model where there is one."""
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


def check_rows_on_host(transitions: Any) -> None:
    """Raises ``SettingError`` unless something is transitions in host memory."""
    check_transitions(transitions)
    check_on_host(**{name: getattr(transitions, name) for name in _NAMES})


def follows_previous(transitions: Transitions, angles: Sequence[int] = ()) -> Tensor:
    """Finds the rows, from the second on, that begin where the one before ended.

    Args:
        transitions: N of them, in their order of time.
        angles: Indices of the states whose whole turns do not count.

    Returns:
        Whether each does, to round-off (N - 1,).
    """
    after = transitions.next_states[:-1]
    now = transitions.states[1:]
    gap = state_difference(after, now, angles).abs().amax(1)
    return gap <= 1e-12 + 1e-9 * now.abs().amax(1)


def _check_finite(name: str, value: Tensor) -> None:
    """Raises ``DataError``, with row and column, unless a table is finite."""
    bad = torch.nonzero(~torch.isfinite(value))
    if len(bad):
        row, column = bad[0].tolist()
        raise DataError(
            f"{name} must be finite; got {float(value[row, column])} in row {row + 1}, "
            f"column {column + 1}"
        )


def _real(key: str, values: Any, names: Sequence[str] = ()) -> Tensor:
    """Copies a table of numbers as float64, its columns in the order of the names."""
    is_tensor = isinstance(values, Tensor) and values.dtype != torch.bool
    if is_tensor and not values.is_complex() and not values.requires_grad:
        return values.to(torch.float64, copy=True)
    rule = "must be numbers in rows and columns"
    return torch.from_numpy(np.array(read_array(key, values, names, rule)))


def _real_next(values: Any, states: Any, signals: Signals) -> Tensor:
    """Reads next states as float64, their columns in the order of the states'.

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
    # labels may be numbers, which say nothing; names are texts, all different
    if not (names_of(values) and signals.state_names):
        return table
    rule = "next_states must have the columns of the states, or these with one prefix"
    raise DataError(
        f"{rule} or suffix; got {', '.join(labels)}, states {', '.join(ours)}"
    )


def _without_affixes(labels: Sequence[Any], names: Sequence[Any]) -> Sequence[Any]:
    """Strips from labels one prefix and one suffix around the names, if there are."""
    if not all(isinstance(label, str) for label in (*labels, *names)):
        return labels
    for prefix, suffix in _affixes(labels[0], names):
        if {f"{prefix}{each}{suffix}" for each in names} == set(labels):
            return [label.removeprefix(prefix).removesuffix(suffix) for label in labels]
    return labels


def _affixes(label: str, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yields what stands before and after each name wherever a label holds it."""
    for name in names:
        place = label.find(name)
        while place >= 0:
            yield label[:place], label[place + len(name) :]
            place = label.find(name, place + 1)


def _check_places(labels: Sequence[str], names: Sequence[str]) -> None:
    """Raises ``DataError`` where columns name all the states in another order.

    A name counts where it is a word of a label: ``x`` in ``x_after``, not in ``max``.
    """

    def named(label: str) -> str:
        patterns = [rf"(?<![^\W_]){re.escape(name)}(?![^\W_])" for name in names]
        named_states = [
            name
            for name, pattern in zip(names, patterns, strict=True)
            if re.search(pattern, label)
        ]
        return max(named_states, key=len, default="")

    order = [named(label) for label in labels]
    if sorted(order) == sorted(names) and order != list(names):
        raise DataError(
            "next_states must stand in the order of the states, or be named as these "
            f"with one prefix or suffix; got {', '.join(labels)}, states "
            f"{', '.join(names)}"
        )


def _check_name_list(key: str, names: Any) -> None:
    """Raises ``SettingError`` where one name stands in the place of a list."""
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise SettingError(key, f"must be a list of column names; got {names!r}")


def _csv_lines(path: str | Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Reads the header of a CSV file, and its lines with their numbers.

    Raises:
        DataError: The file is missing, or a line cannot be read.
    """
    text = _text(path)
    first_line = text.partition("\n")[0]
    delimiter = max(",;\t", key=first_line.count)
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    try:
        lines = [(reader.line_num, fields) for fields in reader]
    except csv.Error as error:
        raise DataError(
            f"{path}: row {reader.line_num} cannot be read ({error})"
        ) from error
    if not lines:
        return [], []
    header = [name.strip() for name in lines[0][1]]
    return header, lines[1:]


def _check_header(path: str | Path, header: list[str], names: list[str]) -> None:
    """Raises ``DataError`` unless each name stands in the header once."""
    for name in names:
        if header.count(name) == 1:
            continue
        problem = "stands there twice" if name in header else "is missing"
        raise DataError(
            f"{path}: column {name!r} {problem}; "
            f"the header has {', '.join(header) or 'no columns'}"
        )


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
    """Reads the numbers of a file's columns (N, d); empty lines do not count.

    Args:
        path: The file, for messages.
        lines: The number and the fields of each line.
        columns: The place of each column by its name.
        width: Number of fields that a line must have.
        least: Least number of lines.
    """
    rows = []
    for line, fields in lines:
        if not fields:
            continue
        if len(fields) != width:
            raise DataError(
                f"{path}: row {line} has {len(fields)} columns; expected {width}"
            )
        row = [
            _number(path, line, name, fields[place]) for name, place in columns.items()
        ]
        rows.append(row)
    if len(rows) < least:
        raise DataError(
            f"{path}: the file holds {len(rows)} rows; expected {least} or more, "
            f"of {width} columns"
        )
    return np.array(rows)


def _number(path: str | Path, row: int, column: int | str, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or "_" in field:  # Python takes 1_0 for 10
        raise DataError(
            f"{path}: row {row}, column {column} is {field.strip()!r}; "
            "expected a finite number"
        )
    return value


def _from_file(
    path: str | Path,
    states: Any,
    inputs: Any,
    next_states: Any,
    signals: Signals = UNKNOWN,
) -> Transitions:
    """Makes transitions; the message of an error names the file."""
    try:
        return Transitions(states, inputs, next_states, signals)
    except GpmpcError as error:
        raise DataError(f"{path}: {error}") from error
