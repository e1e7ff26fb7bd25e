"""Finds out how a text of rows is written, and prepares it for pandas.

Programs differ in the encoding, the delimiter, the decimal mark, in where they put
comments, and in whether they name the columns. Each is recognised by the text itself,
or refused by its name; none is guessed from the language of the machine. The text is
read line by line, so that what it takes is the table.
"""

import codecs
import csv
import io
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from typing import NamedTuple

from gpmpc.exceptions import DataError
from gpmpc.logs._csv_numbers import doubtful_columns
from gpmpc.logs._units import is_known, is_name_of_time, unit_of_time

WHITE_SPACE = " "  # as a delimiter: any number of spaces and tabs
#: the first of those that fit equally well is taken
DELIMITERS = (";", "\t", ",", WHITE_SPACE)
_COMMENT = re.compile(r"\s*(#|%|//)\s*")
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+([eE][+-]?\d+)?\s*")
_WIDE_SPACE = re.compile(r"\t| {2,}")
_BRACKETS = re.compile(r"\[.*\]|\(.*\)")
_ABSENT = frozenset(("", "NA", "N/A", "n/a", "null", "NULL", "None", "<NA>"))
_SAMPLE = 50  # lines by which the text is recognised
_LONGEST_HEAD = 1000  # lines in which rows are looked for,
_LARGEST_HEAD = 2**18  # and characters
_COMMENTS = 50  # before the first line that may hold the names of the columns
_NAME_LINES = 2  # lines before the rows that may hold the names, and the units
_START = 1000  # bytes that the encoding is looked for in
_ENCODING_MARKS = (  # the longer marks first: that of UTF-32 begins as that of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)

Fields = list[str]


class CsvText(NamedTuple):
    """The rows of a text in the form that pandas reads, and how it is written."""

    stream: "_CsvStream"  #: the rows, without names and comments
    #: of the columns, as they stand there: a name may be empty, or come twice; none
    #: where the text names no column
    names: Fields
    units: Fields  #: of the columns, as the line below the names says; none without one
    columns: int  #: their number
    delimiter: str  #: ``WHITE_SPACE`` for any of it
    decimal: str
    #: numbers of columns, from 0 on, that are to be read as texts: what the decimal
    #: mark means in them is not sure (``_csv_numbers``)
    doubtful: list[int]
    skipped: int  #: lines before the rows: neither names, nor units, nor comments
    lines_before_rows: int  #: comments and blank ones left out

    @property
    def rows_behind_blank(self) -> list[int]:
        """The row behind each blank line between rows, known where all is read.

        They are counted from 0 on; a row comes once for each blank line before it.
        """
        rows = (
            line - self.lines_before_rows for line in self.stream.lines.behind_blank
        )
        return [row for row in rows if row > 0]

    @property
    def is_cut(self) -> bool:
        """Whether the last line has no end, known where all is read.

        It may be cut within a number, and is left out.
        """
        return self.stream.lines.is_cut


class _ColumnNames(NamedTuple):
    """The names of the columns and their units, and the count of the other lines."""

    names: Fields
    units: Fields
    skipped: int


def open_csv(where: str, file: io.BufferedReader) -> CsvText:
    """Finds out how a text of rows is written.

    Args:
        where: The file's name, for errors.
        file: The text, unpacked. Lines that begin with #, % or // are comments. The
            last line before the rows that has as many fields as they names the columns,
            also in a comment; behind it may stand a line of units.

    Raises:
        DataError: It is no such text; the message says why.
    """
    lines = _Lines(where, file)
    head = _read_head(lines)
    if not head:
        raise DataError(
            f"{where}: holds no line with the names of the columns, or rows"
        )
    delimiter = _find_delimiter(head[-_SAMPLE:])
    fields = [_split_line(line, delimiter) for line in head]
    first_row = _first_row(fields, delimiter)
    rows = fields[first_row:]
    if delimiter == ",":
        _check_decimal_commas(where, fields[first_row - 1 : first_row], rows)
    column_names = _find_names(
        head[:first_row],
        lines.comments,
        rows,
        delimiter,
        have_names=_are_numbered(rows) and head[first_row].lstrip().startswith('"'),
    )
    columns = max([len(column_names.names), *map(len, rows)])
    decimal = _decimal_mark(rows)
    width = columns if delimiter == WHITE_SPACE else 0
    return CsvText(
        stream=_CsvStream(head[first_row:], lines, width),
        names=column_names.names,
        units=column_names.units,
        columns=columns,
        delimiter=delimiter,
        decimal=decimal,
        doubtful=doubtful_columns(rows, decimal),
        skipped=column_names.skipped,
        lines_before_rows=first_row,
    )


def _read_head(lines: Iterator[str]) -> list[str]:
    """Reads lines until the last ones are rows, as far as a program's settings go."""
    head = list(islice(lines, 1 + _SAMPLE))
    while len(head) < _LONGEST_HEAD and not _are_rows(head[-_SAMPLE:]):
        if sum(map(len, head)) > _LARGEST_HEAD:
            break
        following = list(islice(lines, _SAMPLE))
        if not following:
            break
        head += following
    return head


def _are_rows(lines: Sequence[str]) -> bool:
    """Tells whether lines are surely rows: equally wide, and each begins with a number.

    Settings begin with their names. So may rows: then all of the head is looked at.
    """
    if not lines:
        return False
    delimiter = _find_delimiter(lines)
    fields_of_lines = [_split_line(line, delimiter) for line in lines]
    is_even = len({len(fields) for fields in fields_of_lines}) == 1
    return is_even and all(_is_number(fields[0]) for fields in fields_of_lines)


class _Lines(Iterator[str]):
    """The lines of a file without blank ones, comments and a last one that is cut."""

    def __init__(self, where: str, file: io.BufferedReader):
        self.encoding = _find_encoding(file.peek(_START)[:_START])
        self.comments: list[str] = []  # before the first line, the last ones
        self.is_cut = False  # the last line has no end
        #: for each blank line, the number of the line behind it, from 0 on, among those
        #: that are neither blank nor comments
        self.behind_blank = array("q")
        self.where = where
        self.count = 0  # of the lines that were read
        self._stream = io.TextIOWrapper(file, encoding=self.encoding)
        self._began = False
        self._others = 0  # lines that are neither blank nor comments

    def __next__(self) -> str:
        blank = 0
        while True:
            line = self._read_line()
            if not line:
                raise StopIteration
            if not line.endswith("\n") and self._began:
                self.is_cut = True
                raise StopIteration
            comment = _COMMENT.match(line)
            if comment is None and line.strip():
                self._began = True
                self._others += 1
                self.behind_blank.extend([self._others - 1] * blank)
                return line
            blank += comment is None
            if comment is not None and not self._began:
                self.comments = [*self.comments[1 - _COMMENTS :], line[comment.end() :]]

    def _read_line(self) -> str:
        """Reads the next line with its end; an empty one behind the last."""
        self.count += 1
        try:
            return self._stream.readline()
        except UnicodeDecodeError as error:
            byte = f"byte 0x{error.object[error.start]:02x} near line {self.count}"
            name = self.encoding.removesuffix("-sig").upper()
            raise DataError(
                f"{self.where}: {byte} is no text in {name}: save the file as UTF-8"
            ) from error


class _CsvStream(io.TextIOBase):
    """A text stream for pandas: the rows of the head, and those behind them."""

    def __init__(self, head: list[str], lines: _Lines, width: int):
        self.lines = lines
        self._width = width  # fields that every row must have; 0 for any
        self.rows = 0  # that were read
        self._all_lines = chain(head, lines)
        self._unread = ""  # of the line that was read last

    def read(self, size: int | None = -1, /) -> str:
        """Reads the next ``size`` characters; all of them where it is negative."""
        length = len(self._unread)
        lines = [self._unread]
        while size is None or size < 0 or length < size:
            line = next(self._all_lines, "")
            if not line:
                break
            self._check_width(line)
            lines.append(line)
            length += len(line)
        text = "".join(lines)
        if size is None or size < 0:
            size = len(text)
        self._unread = text[size:]
        return text[:size]

    def _check_width(self, line: str) -> None:
        """Raises ``DataError`` where white space separates another number of fields.

        A blank cell looks like more space: which column it is of cannot be told.
        """
        self.rows += 1
        if not self._width:
            return
        width = len(_split_line(line, WHITE_SPACE))
        if width != self._width:
            raise DataError(
                f"{self.lines.where}: row {self.rows} has {width} fields, others "
                f"{self._width}: white space cannot mark an empty cell; separate "
                "columns by commas"
            )


def _find_encoding(start: bytes) -> str:
    """Returns the encoding of a text by its first bytes: UTF-8, or that of its mark."""
    for mark, encoding in _ENCODING_MARKS:
        if start.startswith(mark):
            return encoding
    if start.count(0) <= len(start) // 4:
        return "utf-8-sig"
    # every second byte of Latin letters is zero
    return "utf-16-le" if start[1:2] == b"\0" else "utf-16-be"


def _split_line(line: str, delimiter: str) -> Fields:
    """Returns the fields of one line, without their quotes and the space around."""
    if delimiter == WHITE_SPACE:
        if '"' not in line:
            return line.split()
        line = " ".join(line.split())
    fields = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [field.strip() for field in fields]


def _is_number(field: str) -> bool:
    if _DECIMAL_COMMA.fullmatch(field):
        return True
    try:
        float(field)
    except ValueError:
        return False
    return True


def _is_text(field: str) -> bool:
    return field not in _ABSENT and not _is_number(field)


def _find_delimiter(lines: Sequence[str]) -> str:
    """Finds the delimiter that makes most numbers of some lines, and fewest texts."""

    def count(delimiter: str) -> tuple[int, int]:
        fields = [f for line in lines for f in _split_line(line, delimiter)]
        numbers = sum(_is_number(field) for field in fields)
        texts = sum(_is_text(field) for field in fields)
        return numbers, -texts

    counts = {delimiter: count(delimiter) for delimiter in DELIMITERS}
    if any(numbers for numbers, _ in counts.values()):
        return max(DELIMITERS, key=lambda delimiter: counts[delimiter])
    return max(
        DELIMITERS[:-1], key=lambda delimiter: len(_split_line(lines[0], delimiter))
    )


def _first_row(lines: Sequence[Fields], delimiter: str) -> int:
    """Finds the first line of values; the one behind the first if none has a number.

    What an instrument writes above the rows has numbers too. Between white space rows
    are as wide as most lines at the end of the sample; elsewhere their last cells may
    be missing, but they do not begin with a text where most begin with a number.
    """
    is_numeric = [any(map(_is_number, fields)) for fields in lines]
    widths = Counter(
        len(fields)
        for fields, numeric in zip(lines[-_SAMPLE:], is_numeric[-_SAMPLE:], strict=True)
        if numeric
    )
    usual_width = widths.most_common(1)[0][0] if widths else 0
    is_whole = [
        numeric and len(fields) == usual_width
        for fields, numeric in zip(lines, is_numeric, strict=True)
    ]
    is_short = [
        numeric and not whole
        for numeric, whole in zip(is_numeric, is_whole, strict=True)
    ]
    begins = [_is_text(lines[i][0]) for i, whole in enumerate(is_whole) if whole]
    begin_with_text = sum(begins) > len(begins) / 2

    def may_be_short_row(index: int) -> bool:
        """Tells whether a line may be a row whose last cells are missing."""
        if delimiter == WHITE_SPACE or not is_numeric[index]:
            return False
        if _is_text(lines[index][0]):
            while index + 1 < len(lines) and is_short[index]:
                index += 1
            return begin_with_text and is_whole[index]
        return True

    for index in range(len(lines)):
        if index == 0 and len(lines) > 1 and _is_header(lines[0], lines[1]):
            continue
        if is_whole[index] or may_be_short_row(index):
            while index > 0 and not any(lines[index - 1]):  # rows without a value
                index -= 1
            return index
    return 1


def _is_header(fields: Fields, below: Fields) -> bool:
    """Tells whether a line with numbers names columns, or counts them."""
    return (
        _names_numbers(fields, below)
        or _counts_columns(fields)
        or _counts_from_zero(fields, below)
    )


def _names_numbers(fields: Fields, below: Fields) -> bool:
    """Tells whether a word stands above a number: ``t,1,2`` names columns."""
    return any(
        _is_text(upper) and any(map(str.isalpha, upper)) and _is_number(lower)
        for upper, lower in zip(fields, below, strict=False)
    )


def _counts_columns(fields: Fields) -> bool:
    """Tells whether a line holds 0, 1, ..., as pandas writes it above nameless columns.

    An empty field stands above the index.
    """
    counted = [str(number) for number in range(len(fields) - 1)]
    return len(counted) > 1 and fields[0] == "" and fields[1:] == counted


def _counts_from_zero(fields: Fields, below: Fields) -> bool:
    """Tells whether a line holds 0, 1, ..., as pandas writes it without an index.

    The row below, which has a decimal point, is no such line.
    """
    counted = [str(number) for number in range(len(fields))]
    return len(counted) > 2 and fields == counted and any("." in one for one in below)


def _find_names(
    lines: Sequence[str],
    comments: Sequence[str],
    rows: Sequence[Fields],
    delimiter: str,
    have_names: bool,
) -> _ColumnNames:
    """Finds the names of the columns before the rows.

    Args:
        lines: Those before the rows.
        comments: Those before the first line.
        rows: The first ones; where there is none, the first line has the names.
        delimiter: Of the rows.
        have_names: Whether rows begin with their own names, as R writes them.
    """
    if not rows:
        return _ColumnNames(_split_line(lines[0], delimiter), units=[], skipped=0)
    last = _split_line(lines[-1], delimiter) if lines else []
    if lines and (_counts_columns(last) or _counts_from_zero(last, rows[0])):
        # other numbers than a mapping counts by
        return _ColumnNames([], units=[], skipped=len(lines))
    for separators in ((delimiter,), DELIMITERS):
        names, units = _last_names(lines[-_NAME_LINES:], rows, separators, have_names)
        if names:
            understood = 2 if units else 1
            return _ColumnNames(names, units, skipped=len(lines) - understood)
        names, units = _last_names(comments, rows, separators, have_names)
        if names:
            return _ColumnNames(names, units, skipped=len(lines))
    return _ColumnNames([], units=[], skipped=len(lines))


def _last_names(
    lines: Sequence[str],
    rows: Sequence[Fields],
    separators: Sequence[str],
    have_names: bool,
) -> tuple[Fields, Fields]:
    """Returns the names in the last line that has some, and the units in one behind."""
    candidates = [_split_names(line, rows, separators, have_names) for line in lines]
    candidates = [names for names in candidates if names]
    if len(candidates) > 1 and _are_units(candidates[-1], candidates[-2]):
        units = [field.strip("[]() ") for field in candidates[-1]]
        return candidates[-2], units
    return (candidates[-1], []) if candidates else ([], [])


def _split_names(
    line: str, rows: Sequence[Fields], separators: Sequence[str], have_names: bool
) -> Fields:
    """Splits a line into as many names as rows have fields; none if it has others.

    A name at the end may be empty, as may a cell. R puts no name above those of its
    rows, and all names in quotes.
    """
    widest = max(len(fields) for fields in rows)
    filled = max(_count_filled(fields) for fields in rows)
    for separator in separators:
        names = _split_line(line, separator)
        if _count_filled(names) <= widest and len(names) >= filled:
            return [] if _are_sentences(names, separator) else names
        is_one_less = len(names) == filled - 1 and line.lstrip().startswith('"')
        if have_names and is_one_less and not _are_sentences(names, separator):
            return ["", *names]
    if WHITE_SPACE in separators:  # names of several words
        names = [name.strip() for name in _WIDE_SPACE.split(line.strip())]
        return names if len(names) == widest else []
    return []


def _are_numbered(rows: Sequence[Fields]) -> bool:
    """Tells whether rows begin with 1, 2, ..."""
    numbers = [str(number) for number in range(1, len(rows) + 1)]
    return len(rows) > 1 and [fields[0] for fields in rows] == numbers


def _are_sentences(names: Fields, separator: str) -> bool:
    """Tells whether a line is rather a sentence than names, by its marks."""
    if separator == WHITE_SPACE:
        return any(name.endswith((".", ":", ",")) for name in names)
    return any(": " in name for name in names)


def _count_filled(fields: Fields) -> int:
    """Counts the fields up to the last one that is not empty."""
    filled = [index for index, field in enumerate(fields) if field]
    return filled[-1] + 1 if filled else 0


def _are_units(fields: Fields, names: Fields) -> bool:
    """Tells whether fields below names are units, such as ``[s]`` and ``N m``.

    All are known, or one is a unit of times and stands below the name of a time: then
    others are units that are not known here. Fields that come twice below names that
    do not are no names: RAD below THE and PHI. Below a title they may be, with a time.
    """
    filled = [field for field in fields if field]
    has_repeats = len({*filled}) < len(filled)
    has_time = any(is_name_of_time(field) for field in filled)
    if has_repeats and not has_time and len({*names}) == len(names):
        return True
    units = [field.strip("[]() ") for field in fields]
    are_known = all(
        is_known(unit) or _BRACKETS.fullmatch(field)
        for unit, field in zip(units, fields, strict=True)
    )
    return are_known or any(
        unit_of_time(unit) and is_name_of_time(name)
        for unit, name in zip(units, names, strict=False)
    )


def _decimal_mark(rows: Sequence[Fields]) -> str:
    """Returns the decimal mark of the first rows."""
    has_commas = any(_DECIMAL_COMMA.fullmatch(f) for fields in rows for f in fields)
    return "," if has_commas else "."


def _check_decimal_commas(
    where: str, above: Sequence[Fields], rows: Sequence[Fields]
) -> None:
    """Raises ``DataError`` where commas separate fields and seem decimal marks, too.

    Args:
        where: The file's name, for errors.
        above: The fields of the line before the rows, if there is one.
        rows: The first ones.
    """
    widths = [len(fields) for fields in rows]
    has_points = any("." in field for fields in rows for field in fields)
    if has_points or not widths or not above:
        return
    names = len(above[0])
    is_double = names > 1 and min(widths) >= 2 * names
    is_pair = names == 1 and " " not in above[0][0] and {*widths} == {2}
    if is_double or is_pair:
        raise DataError(
            f"{where}: the rows have {min(widths)} fields and the header {names}: is "
            "the comma the decimal mark too? separate columns by semicolons"
        )
