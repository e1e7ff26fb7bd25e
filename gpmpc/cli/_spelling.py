"""Tells what a misspelt word may stand for."""

import difflib
from collections.abc import Iterable


def nearest(name: str, names: Iterable[str]) -> str:
    """Returns what a misspelt name may stand for, as a question.

    Of a name without dots the last parts are compared.
    """

    def compared(key: str) -> str:
        return key.lower() if "." in name else key.rpartition(".")[2].lower()

    candidates = [*names]
    close = difflib.get_close_matches(
        name.lower(), {compared(key) for key in candidates}, n=1
    )
    meant = [key for key in candidates if compared(key) in close]
    meant.sort(key=lambda key: key.count("."))
    without_dots = [key for key in meant if "." not in key]
    shown = without_dots or meant[:3]
    return f" (did you mean {' or '.join(map(repr, shown))}?)" if shown else ""
