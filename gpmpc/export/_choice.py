"""As many points as a chip holds, and what fewer cost.

all points -> flown -> counts of points, the most first
                         |_ sparse model -> footprint on the chip
                         |_ one-step error, closed-loop cost
budget -> the largest count that fits, found by halving
"""

import difflib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_kind, check_number
from gpmpc.export._checks import check_exportable
from gpmpc.export._chip import (
    ChipName,
    Footprint,
    available_chip,
    check_chip,
    check_counts_instructions,
    measure_footprint,
)
from gpmpc.export._filter import Estimator
from gpmpc.export._points import informative_order, posterior_of
from gpmpc.export._price import Fly, cost_of, flight_of, ratio_of_errors
from gpmpc.export._text import Precision
from gpmpc.export._write import reduce_points
from gpmpc.mpc import GPMPC

# of neighbouring counts in the table
_RATIO = 0.6
# steps of the flight in which instructions are counted
_REPLAYED = 20
_EXAMPLE = "flash=64kB,ram=32kB,instructions=2M"
_AMOUNT = re.compile(r"(?P<number>[0-9]*\.?[0-9]+)\s*(?P<unit>[a-z]*)")
_BYTES = {"": 1, "b": 1, "k": 1024, "m": 1024**2}
_BYTES |= {f"{unit}{end}": _BYTES[unit] for unit in "km" for end in ("b", "ib")}
_COUNTS = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3}


@explains_arguments
@dataclass(frozen=True)
class Budget:
    """What exported code may take on a chip; None for no limit.

    Raises:
        SettingError: A limit is no positive number, or there is none.

    >>> Budget.parse("flash=64kB,ram=32kB")
    Budget(flash=65536, ram=32768, instructions=None)
    """

    flash: float | None = None  #: code and tables [B]
    ram: float | None = None  #: controller, reference and stack [B]
    instructions: float | None = None  #: of the longest step of a flight

    def __post_init__(self) -> None:
        limits = {field.name: getattr(self, field.name) for field in fields(self)}
        for key, limit in limits.items():
            if limit is not None:
                check_number(f"budget.{key}", limit, above=0)
        if all(limit is None for limit in limits.values()):
            raise SettingError("budget", f"must limit something, such as {_EXAMPLE}")

    @classmethod
    def parse(cls, text: str) -> "Budget":
        """Reads a budget such as ``flash=64kB,ram=32kB,instructions=2M``.

        Of bytes, k and M are 1024 and its square; of instructions, thousands and
        millions.

        Raises:
            SettingError: It cannot be read.
        """
        limits: dict[str, float] = {}
        for entry in filter(None, re.split(r"[,;\s]+", text)):
            key, _, amount = entry.partition("=")
            key = key.lower()
            _check_key(key, entry, limits)
            limits[key] = _amount(entry, key, amount)
        return cls(**limits)

    def excesses(self, footprint: Footprint) -> list[str]:
        """Returns what a footprint takes too much of, with its limit, in words."""
        demands = {
            "flash": footprint.flash,
            "ram": footprint.memory,
            "instructions": footprint.worst,
        }
        excesses = []
        for key, amount in demands.items():
            limit = getattr(self, key)
            if limit is not None and (amount is None or amount > limit):
                excesses.append(
                    f"{_words(key, amount)} of {key} where the budget is "
                    f"{_words(key, limit)}"
                )
        return excesses


class PointRow(NamedTuple):
    """What so many points take, and what they cost beside all."""

    points: int
    footprint: Footprint
    error: float  #: one-step error along the flight, all points 1
    #: tracking cost of the flight, all points 1; infinite where it came to no end
    cost: float


@dataclass(frozen=True)
class PointChoice:
    """The largest number of points that fits a budget.

    See Also:
        ``choose_points``, which returns it; ``export_c``, which takes its ``points``.
    """

    points: int
    rows: tuple[PointRow, ...]  #: the most points first, which are all of them
    budget: Budget

    @property
    def chosen(self) -> PointRow:
        """The row of ``points``."""
        return next(row for row in self.rows if row.points == self.points)

    def table(self) -> str:
        """Returns the rows as a table, and what measured them."""
        head = "points | one-step error | cost | flash | RAM | stack | instructions"
        names = head.split(" | ")
        lines = [names, ["---:"] * len(names)]
        lines += [_cells(row, row.points == self.points) for row in self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(names))]
        lines[1] = ["-" * (width - 1) + ":" for width in widths]
        table = "\n".join(
            "| "
            + " | ".join(
                cell.rjust(width) for cell, width in zip(line, widths, strict=True)
            )
            + " |"
            for line in lines
        )
        return f"{table}\n\nmeasured: {self.chosen.footprint.compiler}"


@explains_arguments
def choose_points(
    controller: GPMPC,
    fly: Fly,
    budget: Budget,
    chip: ChipName | None = None,
    precision: Precision = "double",
    on_failure: str = "previous_plan",
    estimator: Estimator | None = None,
    progress: Callable[[str], None] | None = None,
) -> PointChoice:
    """Finds the largest number of points whose exported code fits a budget.

    The code is compiled, and where QEMU is installed replayed, for each number that is
    looked at; the controller of these points is flown. Points are those that explain
    most (``with_points``); fewer than a plane needs, one more than there are features,
    are not looked at.

    Args:
        controller: Of all points, as ``export_c`` takes it.
        fly: Flies a controller and returns the ``Rollout``, such as a function that
            calls ``closed_loop``; with the same noise each time.
        budget: What the code may take.
        chip: See ``measure_footprint``; by default ``"cortex-m4f"`` where there is a
            compiler for it, else ``"host"``.
        precision: See ``export_c``.
        on_failure: See ``export_c``.
        estimator: See ``export_c``. Its filter takes flash and RAM; instructions are
            not counted with one, since a flight does not say what its sensors showed.
        progress: Called with a line before each part of the work.

    Returns:
        The number, for ``export_c(..., points=...)``, and a table.

    Raises:
        SettingError: Nothing fits, the controller cannot be exported or has no points,
            or a tool is not installed.

    See Also:
        ``with_points`` for a number of your own; ``measure_footprint``.
    """
    check_exportable(controller, on_failure)
    check_kind("budget", budget, Budget, "a Budget(flash=..., ram=...)")
    if not callable(fly):
        raise SettingError("fly", f"must be a function of a controller; got {fly!r}")
    chip = available_chip() if chip is None else chip
    check_chip(chip)
    search = _Search(
        controller,
        fly=fly,
        budget=budget,
        chip=chip,
        precision=precision,
        on_failure=on_failure,
        estimator=estimator,
        progress=progress or _ignore,
    )
    return search.run()


class _Search:
    """The search for the largest number of points that fits."""

    def __init__(
        self,
        controller: GPMPC,
        fly: Fly,
        budget: Budget,
        chip: ChipName,
        precision: Precision,
        on_failure: str,
        estimator: Estimator | None,
        progress: Callable[[str], None],
    ):
        self._controller = controller
        self._model = controller.prediction.model
        self._fly = fly
        self._budget = budget
        self._chip: ChipName = chip
        self._precision: Precision = precision
        self._on_failure = on_failure
        self._estimator = estimator
        self._progress = progress
        self._footprints: dict[tuple[int, bool], Footprint] = {}
        # between the rows of the table, only what the budget limits is measured
        self._searches_instructions = budget.instructions is not None
        self._size = len(posterior_of(self._model))
        self._informative = len(informative_order(self._model))
        if budget.instructions is not None:
            check_counts_instructions(chip)
            if estimator is not None:
                rule = "instructions are counted without an estimator; limit the others"
                raise SettingError("budget", rule)

    def run(self) -> PointChoice:
        """Returns the choice."""
        self._progress(f"flying all {self._size} points")
        self._flight = flight_of(self._fly, self._controller)
        counts = self._counts()
        fitting = [count for count in counts if self._fits(count)]
        if not fitting:
            least = counts[-1]
            footprint = self._footprint(least)
            excesses = " and ".join(self._budget.excesses(footprint))
            raise SettingError(
                "budget",
                f"nothing fits: {least} points, the fewest, need {excesses}; "
                f"measured: {footprint.compiler}",
            )
        points = self._largest(fitting[0], counts)
        rows = [self._row(count) for count in sorted({*counts, points}, reverse=True)]
        return PointChoice(points=points, rows=tuple(rows), budget=self._budget)

    def _counts(self) -> list[int]:
        """Returns the numbers of points that a table shows, the most first."""
        most = self._most_sparse
        least = min(posterior_of(self._model).features.shape[1] + 1, most)
        counts = [self._size, most]
        while counts[-1] * _RATIO > least:
            counts.append(round(counts[-1] * _RATIO))
        return sorted({*counts, least}, reverse=True)

    @property
    def _most_sparse(self) -> int:
        """The most points below all that explain something."""
        return max(1, min(self._informative, self._size - 1))

    def _largest(self, fits: int, counts: Sequence[int]) -> int:
        """Returns the largest number that fits, by halving up to the next of counts."""
        if fits in (self._size, self._most_sparse):
            return fits
        too_many = counts[counts.index(fits) - 1]
        while too_many - fits > 1:
            middle = (too_many + fits) // 2
            if self._fits(middle, replays=self._searches_instructions):
                fits = middle
            else:
                too_many = middle
        return fits

    def _fits(self, count: int, replays: bool = True) -> bool:
        """Returns whether the code of so many points is within the budget.

        A number that was found without a replay is compiled again for its row.
        """
        return not self._budget.excesses(self._footprint(count, replays))

    def _footprint(self, count: int, replays: bool = True) -> Footprint:
        """Returns what the code of so many points takes.

        Args:
            count: Of points.
            replays: Whether instructions are counted, where they can be.
        """
        key = (count, replays)
        if key not in self._footprints:
            self._progress(f"compiling {count} points")
            controller, estimator = self._reduced(count)
            questions = self._flight.questions[:_REPLAYED]
            footprint = measure_footprint(
                controller,
                questions if replays and estimator is None else (),
                chip=self._chip,
                precision=self._precision,
                on_failure=self._on_failure,
                estimator=estimator,
            )
            if self._budget.ram is not None and footprint.stack is None:
                rule = "ram holds the stack, which gcc 10 and newer tell; leave ram out"
                raise SettingError("budget", f"{rule}; got {footprint.compiler}")
            self._footprints[key] = footprint
        return self._footprints[key]

    def _reduced(self, count: int) -> tuple[GPMPC, Estimator | None]:
        """Returns controller and filter of so many points."""
        return reduce_points(self._controller, self._estimator, count)

    def _row(self, count: int) -> PointRow:
        """Returns the row of so many points, which are flown."""
        footprint = self._footprint(count)
        if count == self._size:
            return PointRow(count, footprint, error=1.0, cost=1.0)
        self._progress(f"flying {count} points")
        reduced, _ = self._reduced(count)
        error = ratio_of_errors(reduced.prediction.model, self._model, self._flight)
        cost = cost_of(self._fly, reduced)
        return PointRow(count, footprint, error, _ratio(cost, self._flight.cost))


def _ratio(cost: float, of_all: float) -> float:
    """Returns a cost beside another; 1 where both are zero."""
    if of_all > 0:
        return cost / of_all
    return 1.0 if cost == of_all else math.inf


def _ignore(_: str) -> None:
    """Does nothing."""


def _check_key(key: str, entry: str, limits: dict[str, float]) -> None:
    """Raises unless an entry names a limit that was not named before."""
    keys = [field.name for field in fields(Budget)]
    if key not in keys:
        close = difflib.get_close_matches(key, keys, n=1, cutoff=0.7)
        question = f" (did you mean {close[0]!r}?)" if close else ""
        rule = f"must limit {' or '.join(keys)}, such as {_EXAMPLE}"
        raise SettingError("budget", f"{rule}; got {entry!r}{question}")
    if key in limits:
        raise SettingError("budget", f"{key} stands there twice")


def _amount(entry: str, key: str, text: str) -> float:
    """Returns the number of an entry in its unit."""
    units = _COUNTS if key == "instructions" else _BYTES
    match = _AMOUNT.fullmatch(text.strip().lower())
    if match is None or match["unit"] not in units:
        example = "2M" if key == "instructions" else "64kB"
        rule = f"{key} must be a number with k or M, such as {key}={example}"
        raise SettingError("budget", f"{rule}; got {entry!r}")
    amount = float(match["number"]) * units[match["unit"]]
    return int(amount) if amount == int(amount) else amount


def _cells(row: PointRow, chosen: bool) -> list[str]:
    """Returns the cells of a row."""
    footprint = row.footprint
    cost = f"{row.cost:.4f}" if math.isfinite(row.cost) else "lost"
    return [
        f"{row.points} chosen" if chosen else str(row.points),
        "-" if math.isnan(row.error) else f"{row.error:.4f}",
        cost,
        _words("flash", footprint.flash),
        _words("ram", footprint.ram),
        _words("stack", footprint.stack),
        _words("instructions", footprint.worst),
    ]


def _words(key: str, amount: float | None) -> str:
    """Returns an amount as a user reads it."""
    if amount is None:
        return "unknown" if key == "stack" else "no count"
    if key == "instructions":
        return f"{amount / 1e6:.3g} M"
    if amount < 1024:
        return f"{amount:g} B"
    return f"{amount / 1024:.1f} kB"
