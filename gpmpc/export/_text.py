"""Numbers, arrays and comments as C text."""

import re
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

Precision = Literal["double", "float"]

_NUMBERS_A_LINE = 4
_INTEGERS_A_LINE = 7


class Numbers:
    """Writes numbers and arrays of one precision."""

    def __init__(self, precision: Precision):
        self.precision = precision

    def number(self, value: float) -> str:
        """Returns a number that C reads back to the same bits."""
        if self.precision == "float":
            with np.errstate(over="ignore"):
                value = float(np.float32(value))
        if np.isnan(value):
            return "NAN"
        if np.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        if self.precision == "float":
            rounded = np.float32(value)
            text = np.format_float_scientific(rounded, unique=True)
            if abs(float(rounded)) < 1e6 and float(rounded) == int(rounded):
                text = f"{int(rounded)}.0"
            return f"{text}f"
        return repr(float(value))

    def table(
        self, name: str, values: np.ndarray, comment: str = "", kind: str = "real"
    ) -> str:
        """Returns a constant array, flat, row after row."""
        flat = np.ravel(np.asarray(values, dtype=float))
        if not flat.size:
            flat = np.zeros(1)
        numbers = [self.number(value) for value in flat]
        lines = [
            ", ".join(numbers[first : first + _NUMBERS_A_LINE])
            for first in range(0, len(numbers), _NUMBERS_A_LINE)
        ]
        body = ",\n    ".join(lines)
        head = f"/* {comment} */\n" if comment else ""
        return f"{head}static const {kind} {name}[{flat.size}] = {{\n    {body}}};\n"


def integers(
    name: str, values: Sequence[int] | np.ndarray, comment: str = "", kind: str = "int"
) -> str:
    """Returns a constant array of whole numbers."""
    suffix = "u" if kind.startswith("u") else ""
    listed = [f"{int(value)}{suffix}" for value in values] or ["0"]
    head = f"/* {comment} */\n" if comment else ""
    lines = [
        ", ".join(listed[first : first + _INTEGERS_A_LINE])
        for first in range(0, len(listed), _INTEGERS_A_LINE)
    ]
    body = ",\n    ".join(lines)
    return f"{head}static const {kind} {name}[{len(listed)}] = {{{body}}};\n"


def function(signature: str, body: Sequence[str], note: str) -> str:
    """Returns a function, what it computes above it."""
    lines = "\n".join(f"    {line}" for line in body)
    return f"/* {note} */\n{signature}\n{{\n{lines}\n}}\n"


def split_jacobian(rows: int, n: int, m: int) -> list[str]:
    """Returns the lines of a loop over ``i`` that write A and B, where A is wanted.

    They are the columns of ``jacobian`` (rows, n + m) by the state and by the input.
    """
    d = n + m
    return [
        f"for (i = 0; i < {rows} && A; i++) {{",
        f"    copy(jacobian + i * {d}, A + i * {n}, {n});",
        f"    copy(jacobian + i * {d} + {n}, B + i * {m}, {m});",
        "}",
    ]


def unused(arguments: str, lines: Sequence[str]) -> list[str]:
    """Returns the lines that name those arrays, of a letter each, that others lack."""
    text = "\n".join(lines)
    return [f"(void){a};" for a in arguments if not re.search(rf"\b{a}\[", text)]


def comment(text: str) -> str:
    """Returns text as one line of a comment in C, which it does not end early."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text)
    shown = shown.replace("\\", "/")  # at the end of a line it would go on
    shown = shown.replace("*/", "* /").replace("/*", "/ *")
    return re.sub(r"\?(?=\?)", "? ", shown)  # two begin a trigraph


def needed_parts(text: str, flags: Mapping[str, int]) -> str:
    """Returns code of C without what flags exclude: ``#if`` of these is decided here.

    Args:
        text: With conditions such as ``#if A || !B``; others, such as ``A && B``, stay
            as they are, for the compiler.
        flags: Values by name.
    """
    lines = []
    # by open condition: whether it is decided here, and whether its lines are needed
    conditions: list[tuple[bool, bool]] = []
    for line in text.splitlines():
        tokens = line.split()
        directive = tokens[0] if tokens else ""
        decided, needed = conditions[-1] if conditions else (False, True)
        if directive in ("#if", "#ifdef", "#ifndef"):
            alternatives = " ".join(tokens[1:]).split(" || ")
            is_decided = directive == "#if" and all(
                name.lstrip("!") in flags for name in alternatives
            )
            holds = is_decided and any(_holds(name, flags) for name in alternatives)
            conditions.append((is_decided, holds))
            is_directive = is_decided
        elif directive == "#else":
            conditions[-1] = (decided, not needed if decided else needed)
            is_directive = decided
        elif directive == "#endif":
            conditions.pop()
            is_directive = decided
        else:
            is_directive = False
        if not is_directive and all(part or not own for own, part in conditions):
            lines.append(line)
    return "\n".join(lines) + "\n"


def _holds(name: str, flags: Mapping[str, int]) -> bool:
    """Returns whether a flag is set, or with ``!`` before it is not."""
    return bool(flags[name.lstrip("!")]) is not name.startswith("!")
