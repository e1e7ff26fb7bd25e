"""Finds out how a CSV text is written, and prepares it for pandas.

Programs differ in the encoding, the delimiter, the decimal mark and where they put
comments. Each is recognised by the text itself, or refused by its name; none is guessed
from the language of the machine. The text is read line by line, so that what it takes
is the table.
"""

import codecs
import io
import re
from collections.abc import Iterator
from itertools import chain, islice
from typing import NamedTuple

import pandas as pd

from gpmpc.exceptions import DataError

DELIMITERS = ",;\t"
_COMMENT = re.compile(r"\s*(#|%|//)\s*")
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+([eE][+-]?\d+)?\s*")
_SAMPLE = 50  # lines that the decimal mark is looked for in
_START = 1000  # bytes that the encoding is looked for in
_ENCODING_MARKS = (  # the longer marks first: that of UTF-32 begins as that of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class CsvText(NamedTuple):
    """The text of a CSV file in the form that pandas reads, and how it is written."""

    stream: "_CsvStream"  #: the names of the columns and the rows, without comments
    names: list[str]  #: of the columns
    delimiter: str
    decimal: str  #: the decimal mark

    @property
    def is_cut(self) -> bool:
        """Whether the last line has no end, known where all is read.

        It may be cut within a number, and is left out.
        """
        return self.stream.lines.is_cut


def open_csv(where: str, file: io.BufferedReader) -> CsvText:
    """Finds out how a CSV file is written.

    Args:
        where: The file's name, for errors.
        file: The text, unpacked. Its first line names the columns. Lines that begin
            with #, % or // are comments; the last one before the first line names the
            columns where that line holds numbers.

    Raises:
        DataError: It is no such text; the message says why.
    """
    lines = _Lines(where, file)
    head = list(islice(lines, 1 + _SAMPLE))
    if head and lines.comment and _holds_numbers(head[0]):
        head.insert(0, lines.comment)
    if not head:
        raise DataError(f"{where}: holds no line with the names of the columns")
    delimiter = max(DELIMITERS, key=lambda mark: len(_split_line(head[0], mark)))
    names = [name.strip() for name in _split_line(head[0], delimiter)]
    if len(set(names)) < len(names) or _holds_numbers(head[0]):
        raise DataError(
            f"{where}: the first line must name every column differently; got "
            f"{', '.join(names)}"
        )
    return CsvText(
        stream=_CsvStream(head, lines),
        names=names,
        delimiter=delimiter,
        decimal=_decimal_mark(where, names, head[1:], delimiter),
    )


class _Lines(Iterator[str]):
    """The lines of a file without blank ones, comments and a last one that is cut."""

    def __init__(self, where: str, file: io.BufferedReader):
        self.encoding = _find_encoding(file.peek(_START)[:_START])
        self.comment = ""  # before the first line, the last one
        self.is_cut = False  # the last line has no end
        self._where = where
        self._stream = io.TextIOWrapper(file, encoding=self.encoding)
        self._count = 0
        self._began = False

    def __next__(self) -> str:
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
                return line
            if comment is not None and not self._began:
                self.comment = line[comment.end() :]

    def _read_line(self) -> str:
        """Reads the next line with its end; an empty one behind the last."""
        self._count += 1
        try:
            return self._stream.readline()
        except UnicodeDecodeError as error:
            byte = f"byte 0x{error.object[error.start]:02x} near line {self._count}"
            name = self.encoding.removesuffix("-sig").upper()
            raise DataError(
                f"{self._where}: {byte} is no text in {name}: save the file as UTF-8"
            ) from error


class _CsvStream(io.TextIOBase):
    """A text stream for pandas: the lines of the head, and those behind them."""

    def __init__(self, head: list[str], lines: _Lines):
        self.lines = lines
        self._all_lines = chain(head, lines)
        self._unread = ""  # of the line that was read last

    def read(self, size: int | None = -1, /) -> str:
        """Reads the next ``size`` characters; all of them where it is negative."""
        length = len(self._unread)
        parts = [self._unread]
        while size is None or size < 0 or length < size:
            line = next(self._all_lines, "")
            if not line:
                break
            parts.append(line)
            length += len(line)
        text = "".join(parts)
        if size is None or size < 0:
            size = len(text)
        self._unread = text[size:]
        return text[:size]


def _find_encoding(start: bytes) -> str:
    """Returns the encoding of a text by its first bytes: UTF-8, or that of its mark."""
    for mark, encoding in _ENCODING_MARKS:
        if start.startswith(mark):
            return encoding
    if start.count(0) <= len(start) // 4:
        return "utf-8-sig"
    # every second byte of Latin letters is zero
    return "utf-16-le" if start[1:2] == b"\0" else "utf-16-be"


def _split_line(line: str, delimiter: str) -> list[str]:
    """Returns the fields of one line, without their quotes."""
    frame = pd.read_csv(
        io.StringIO(line),
        sep=delimiter,
        header=None,
        dtype=str,
        keep_default_na=False,
        skipinitialspace=True,
    )
    return frame.iloc[0].tolist()


def _holds_numbers(line: str) -> bool:
    """Tells whether a field of a line is a number; the name of a column is none."""
    delimiter = max(DELIMITERS, key=line.count)
    for field in line.split(delimiter):
        try:
            float(field.strip().strip('"').replace(",", "."))
        except ValueError:
            continue
        return True
    return False


def _decimal_mark(
    where: str, names: list[str], lines: list[str], delimiter: str
) -> str:
    """Returns the decimal mark of the first rows.

    Raises:
        DataError: The comma is the delimiter as well as the decimal mark.
    """
    samples = [_split_line(line, delimiter) for line in lines]
    if any(_DECIMAL_COMMA.fullmatch(field) for fields in samples for field in fields):
        return ","
    width = min((len(fields) for fields in samples), default=0)
    if delimiter == "," and width >= 2 * len(names) > 2:
        raise DataError(
            f"{where}: the rows have {width} fields and the header {len(names)}: is "
            "the comma the decimal mark too? separate columns by semicolons"
        )
    return "."
