"""Problem: observed transitions (x[k], u[k]) -> x[k+1] are what a dynamics model is learned from.

They arrive from a simulation, an ``.npz`` file written here, a CSV file with named columns, or the text format in which
Cao, Lai and Alam published their data. Whatever the source, what comes out is finite float64 of matching shapes, and
what is wrong with a file is said with its name, row and column.
"""

import csv
import io
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import DataError, SettingError, ShapeError, UnsupportedModel
from gpmpc.files import write_whole


@dataclass(frozen=True)
class Transitions:
    """N observed transitions of a system with n states and m inputs, as float64.

    Attributes:
        states: x[k], (N, n).
        inputs: u[k], (N, m); m may be zero.
        next_states: x[k+1], (N, n).

    Raises:
        ShapeError: The three do not belong together.
        DataError: There is no row, or an entry is not finite (its row and column are named, from 1).
    """

    states: Tensor
    inputs: Tensor
    next_states: Tensor

    def __post_init__(self) -> None:
        for name in ("states", "inputs", "next_states"):
            try:
                value = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            except (TypeError, ValueError) as error:
                raise DataError(f"{name} must be numbers in rows and columns; {error}") from error
            if value.dim() != 2:
                raise ShapeError(f"{name} must have two dimensions (rows, columns); got shape {tuple(value.shape)}")
            object.__setattr__(self, name, value)
        if not len(self.states) == len(self.inputs) == len(self.next_states):
            raise ShapeError(
                "states, inputs and next_states must have the same number of rows; "
                f"got {len(self.states)}, {len(self.inputs)} and {len(self.next_states)}"
            )
        if self.states.shape[1] != self.next_states.shape[1]:
            raise ShapeError(
                "states and next_states must have the same number of columns; "
                f"got {self.states.shape[1]} and {self.next_states.shape[1]}"
            )
        if len(self.states) == 0:
            raise DataError("transitions need at least one row; got none")
        for name in ("states", "inputs", "next_states"):
            bad = torch.nonzero(~torch.isfinite(getattr(self, name)))
            if len(bad):
                row, column = bad[0].tolist()
                value = float(getattr(self, name)[row, column])
                raise DataError(f"{name} must be finite; got {value} in row {row + 1}, column {column + 1}")

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

    def targets(self, predicts: str) -> Tensor:
        """What GPs that predict ``"next_state"`` or ``"difference"`` learn of them (N, n).

        Raises:
            UnsupportedModel: They predict values, which transitions do not hold.
        """
        if predicts == "value":
            raise UnsupportedModel(
                "transitions hold no targets of GPs with predicts='value': use condition_on_targets of a posterior, "
                "fit(features, targets, ...) of a trainer"
            )
        return self.next_states - self.states if predicts == "difference" else self.next_states

    def __getitem__(self, rows: slice | Sequence[int]) -> "Transitions":
        """The transitions of some rows, in the order given."""
        return Transitions(self.states[rows], self.inputs[rows], self.next_states[rows])

    def save(self, path: str | Path) -> None:
        """Writes an uncompressed ``.npz`` (no pickle), in one piece or not at all."""
        buffer = io.BytesIO()
        np.savez(buffer, states=self.states.numpy(), inputs=self.inputs.numpy(), next_states=self.next_states.numpy())
        write_whole(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> "Transitions":
        """Reads what ``save`` wrote.

        Raises:
            DataError: The file is missing, damaged, or not such a file.
        """
        path = _existing(path)
        names = ("states", "inputs", "next_states")
        try:
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                missing = [name for name in names if name not in file]
                if missing:
                    raise DataError(f"{path}: array {missing[0]!r} is missing; expected {', '.join(names)}")
                arrays = [file[name] for name in names]
        except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            if isinstance(error, DataError):
                raise
            raise DataError(f"{path}: not a readable .npz file of transitions ({error})") from error
        return _with_path(path, *arrays)

    @classmethod
    def from_text(cls, path: str | Path, state_dim: int = 6, input_dim: int = 3) -> "Transitions":
        """Reads blank-separated columns x[k] (n), u[k] (m), x[k+1] (n), the format of Cao, Lai and Alam's data.

        Raises:
            DataError: The file is missing, a row has another number of columns, or an entry is no finite number.
        """
        path = _existing(path)
        columns = 2 * state_dim + input_dim
        rows = []
        for line, text in enumerate(_text(path).splitlines(), start=1):
            fields = text.split()
            if not fields:
                continue
            if len(fields) != columns:
                raise DataError(
                    f"{path}: row {line} has {len(fields)} columns; expected {columns} "
                    f"({state_dim} states, {input_dim} inputs, {state_dim} next states)"
                )
            rows.append([_number(path, line, column, field) for column, field in enumerate(fields, start=1)])
        if not rows:
            raise DataError(f"{path}: the file holds no rows; expected {columns} columns of numbers")
        table = np.array(rows)
        n, m = state_dim, input_dim
        return _with_path(path, table[:, :n], table[:, n : n + m], table[:, n + m :])

    @classmethod
    def from_csv(
        cls, path: str | Path, states: Sequence[str], inputs: Sequence[str], next_states: Sequence[str] | None = None
    ) -> "Transitions":
        """Reads named columns of a CSV file with a header line.

        Args:
            path: The file; separated by commas, or by semicolons or tabs where the header has them.
            states: Names of the columns x[k].
            inputs: Names of the columns u[k].
            next_states: Names of the columns x[k+1]. ``None`` takes the file for one recording at equal time steps:
                the next row's states are the next states, and the last row only serves as such.

        Raises:
            SettingError: One name was given where a list of them belongs.
            DataError: The file or a column is missing, or an entry is no finite number.
        """
        for key, names in (("states", states), ("inputs", inputs), ("next_states", next_states)):
            if isinstance(names, str):
                raise SettingError(key, f"must be a list of column names; got the single name {names!r}")
        path = _existing(path)
        text = _text(path)
        header = text.partition("\n")[0]
        delimiter = max(",;\t", key=header.count)
        reader = csv.reader(io.StringIO(text), delimiter=delimiter)
        names = [name.strip() for name in next(reader, [])]
        wanted = [*states, *inputs, *(next_states or ())]
        for name in wanted:
            if names.count(name) != 1:
                problem = "is missing" if name not in names else "stands there twice"
                raise DataError(f"{path}: column {name!r} {problem}; the header has {', '.join(names) or 'no columns'}")
        positions = [names.index(name) for name in wanted]
        rows = []
        for fields in _lines(path, reader):
            line = reader.line_num
            if not fields:
                continue
            if len(fields) != len(names):
                raise DataError(f"{path}: row {line} has {len(fields)} columns; expected {len(names)} as in the header")
            rows.append([_number(path, line, names[i], fields[i]) for i in positions])
        least = 1 if next_states else 2
        if len(rows) < least:
            raise DataError(f"{path}: the file holds {len(rows)} rows; expected {least} or more below the header")
        n, m, table = len(states), len(inputs), np.array(rows)
        if next_states:
            return _with_path(path, table[:, :n], table[:, n : n + m], table[:, n + m :])
        return _with_path(path, table[:-1, :n], table[:-1, n:], table[1:, :n])


def check_transitions(transitions: Any) -> None:
    """Raises unless these are transitions.

    Raises:
        SettingError: Something else was given.
    """
    if not isinstance(transitions, Transitions):
        raise SettingError("transitions", f"must be Transitions(...); got {type(transitions).__name__}")


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected a file of transitions")
    return path


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a readable text file ({error})") from error


def _lines(path: Path, reader: Any) -> Iterator[list[str]]:
    try:
        yield from reader
    except csv.Error as error:
        raise DataError(f"{path}: row {reader.line_num} cannot be read ({error})") from error


def _number(path: Path, row: int, column: int | str, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = None
    if value is None or not np.isfinite(value):
        raise DataError(f"{path}: row {row}, column {column} is {field.strip()!r}; expected a finite number")
    return value


def _with_path(path: Path, states: np.ndarray, inputs: np.ndarray, next_states: np.ndarray) -> Transitions:
    try:
        return Transitions(*(torch.from_numpy(np.array(a, dtype=float)) for a in (states, inputs, next_states)))
    except (DataError, ShapeError, ValueError, TypeError) as error:
        raise DataError(f"{path}: {error}") from error
