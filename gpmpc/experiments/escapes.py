"""Problem: names and messages that a user chose are text in every document, and a command or markup in none.

One function a format; rich shows ``rich.text.Text`` as it is, and HTML has ``html.escape``.
"""

import re
from typing import Any

LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "—": "--"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
)
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
LONGEST = 60  # in a figure, in characters


def in_plain_text(text: object) -> str:
    """On one line; what cannot be printed as its escape, so that it neither breaks a table nor steers a terminal.

    Raises:
        TypeError: It is no text.
    """
    if not isinstance(text, str):
        raise TypeError(f"must be a text; got {text!r:.80}")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def in_markdown(text: str) -> str:
    """Neither HTML, nor a link, emphasis, formula or the end of a table's cell."""
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"[\\`*|~$]|(?<!\w)_|_(?!\w)|(?<=\])[(\[]", r"\\\g<0>", text)


def in_latex(text: str) -> str:
    """No command."""
    return text.translate(LATEX)


def in_csv(value: Any) -> Any:
    """No formula: a spreadsheet takes for one what begins so and is no number."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) and not NUMBER.fullmatch(value):
        return f"'{value}"
    return value


def in_figure(text: str) -> str:
    """No formula, and no wider than a figure."""
    return (text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…").replace("$", r"\$")
