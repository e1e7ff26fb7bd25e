"""Problem: what was measured has to be read by people, by programs, and beside what was measured before.

One measurement is one JSON document: where (machine, versions, commit), how (settings) and the rows, plain dictionaries
that all have ``part``, ``what`` and ``median`` [ms]. Markdown and figures are made from it, and ratios of two of them.
One that is incomplete has ``incomplete``, how many groups of every part there are and are measured; everything that is
made from it says so.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gpmpc.exceptions import DataError

TIMES = """Processor time of one thread in milliseconds. Contenders take turns, call by call; a call is one sample.
*Flushed* calls come after a walk through memory that empties the core's own caches."""

Row = Mapping[str, object]

TIMES_OF = ("median", "p95", "p99", "max", "samples", "model", "build", "solve")
RESULTS = (
    "unsolved",
    "ratio",
    "kkt",
    "kkt_worst",
    "within",
    "ratio_warm",
    "cost",
    "rmse",
    "failed",
    "flights",
    "front",
    "lost",
    "peak_mb",
)


def document(
    rows: Sequence[Row],
    groups: Mapping[str, tuple[int, int]],
    sittings: Sequence[Mapping],
    settings: Mapping,
    provenance: Mapping,
) -> dict:
    """The document itself, as plain data.

    Args:
        rows: What was measured.
        groups: Of every part: how many are measured, and how many there are.
        sittings: Of ``gpmpc.bench.groups.Kept``, with their ``machine``; the document's own is that of the first one.
        settings: How it was measured.
        provenance: Who measured.
    """
    missing = any(measured < planned for measured, planned in groups.values())
    return {
        "gpmpc bench": 1,
        **({"incomplete": {part: list(counts) for part, counts in groups.items()}} if missing else {}),
        "machine": sittings[0]["machine"],
        "settings": settings,
        "provenance": provenance,
        "sittings": list(sittings),
        "rows": list(rows),
    }


def as_json(document: Mapping) -> str:
    """The document as it is kept."""
    return json.dumps(document, indent=1, allow_nan=True) + "\n"


def read_json(path: str | Path) -> dict:
    """A document that was written before.

    Raises:
        DataError: There is no such file, or it holds something else.
    """
    try:
        found = json.loads(Path(path).read_text())
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise DataError(f"{path} is no JSON document of gpmpc bench: {error}") from error
    if not isinstance(found, dict) or "gpmpc bench" not in found or not isinstance(found.get("rows"), list):
        raise DataError(f"{path} is no JSON document of gpmpc bench")
    return found


def described(machine: Mapping) -> str:
    """The machine in a sentence."""
    caches = ", ".join(f"{level} {size}" for level, size in machine["caches"].items()) or "caches unknown"
    load = "" if machine["load"] is None else f"; load when it began: {machine['load']}"
    return (
        f"{machine['processor']}, {machine['cores']} cores, {caches}; {machine['threads']} thread; "
        f"{machine['dgemm_gflops']} GFlop/s in a matrix product, {machine['memory_gb_per_s']} GB/s from memory{load}"
    )


def missing(document: Mapping) -> str:
    """How much of an incomplete measurement there is; empty where it is complete."""
    if "incomplete" not in document:
        return ""
    counts = ", ".join(f"{part} {measured} of {there}" for part, (measured, there) in document["incomplete"].items())
    return f"incomplete, groups measured: {counts}"


def markdown(document: Mapping) -> str:
    """The document for people."""
    rows, sittings = document["rows"], document["sittings"]
    sections = [f"# What it costs\n\n{described(document['machine'])}."]
    if lacking := missing(document):
        sections.append(f"**{lacking.capitalize()}.**")
    if len(sittings) > 1:
        told = [f"{sitting['groups']} groups from {sitting['created']} on" for sitting in sittings]
        sections.append(f"Measured in {len(sittings)} sittings: {', '.join(told)}.")
    sections.append(TIMES)
    steps = [row for row in rows if row["part"] in ("linearisation", "step")]
    if steps:
        sections += ["## Control steps\n\nMilliseconds, median (99 %).", steps_markdown(steps)]
    for part in dict.fromkeys(row["part"] for row in rows if row["part"] not in ("linearisation", "step")):
        here = [row for row in rows if row["part"] == part]
        sections.append(f"## {part.capitalize()}")
        for kind in dict.fromkeys(row.get("kind") for row in here):
            sections += [f"### {kind.capitalize()}"] if kind else []
            sections.append(plain_markdown([row for row in here if row.get("kind") == kind]))
    return "\n\n".join(sections) + "\n"


def table(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; all but the first column aligned to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def ms(value: float) -> str:
    """Milliseconds with three digits."""
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def steps_markdown(rows: Sequence[Row]) -> str:
    """Part ``steps``: a table for every n and cache, sizes down, horizons across."""
    sections = []
    for cache, n in dict.fromkeys((row["cache"], row["n"]) for row in rows):
        here = [row for row in rows if (row["cache"], row["n"]) == (cache, n)]
        columns = list(dict.fromkeys((row["what"], row["H"]) for row in here))
        found = {(row["N"], row["what"], row["H"]): row for row in here}
        sizes = sorted({row["N"] for row in here})
        header = ["", *(f"{N} points" for N in sizes)]
        cells = []
        for what, horizon in sorted(columns, key=lambda c: (c[1] is not None, [w for w, _ in columns].index(c[0]))):
            name = what if horizon is None else f"{what}, H = {horizon}"
            values = [found.get((N, what, horizon)) for N in sizes]
            cells.append([name, *("" if v is None else f"{ms(v['median'])} ({ms(v['p99'])})" for v in values)])
        sections.append(f"### n = {n}, m = {n // 2}, {cache} caches\n\n{table(header, cells)}")
    return "\n\n".join([*sections, _shares(rows)])


def _shares(rows: Sequence[Row]) -> str:
    """Where a step goes: model, build and solve of the largest n, in the middle of the sizes, the first cache."""
    steps = [row for row in rows if row["part"] == "step"]
    if not steps:
        return ""
    cache, n = steps[0]["cache"], max(row["n"] for row in steps)
    sizes = sorted({row["N"] for row in steps})
    size = sizes[len(sizes) // 2]
    header = ["", "model", "build", "solve", "whole step"]
    cells = [
        [f"{row['what']}, H = {row['H']}", *(ms(row[part]) for part in ("model", "build", "solve", "median"))]
        for row in steps
        if (row["cache"], row["n"], row["N"]) == (cache, n, size)
    ]
    title = f"### Where a step goes: n = {n}, {size} points, {cache} caches (model, build and solve by the wall clock)"
    return f"{title}\n\n{table(header, cells)}"


def plain_markdown(rows: Sequence[Row]) -> str:
    """Any other part: one table, a row a row, with every column that any of them has."""
    columns = [
        c
        for c in dict.fromkeys(key for row in rows for key in row)
        if c not in ("part", "kind", "tolerance", "lost", "family")
    ]
    return table(columns, [[_cell(row.get(column)) for column in columns] for row in rows])


def compared(old: Mapping, new: Mapping) -> list[dict]:
    """Ratios new / old of the medians of all rows that both documents have, the greatest first.

    Beside each stands the ratio after the two machines' rates of a matrix product are divided out (``per_gflop``).
    """
    before = {_identity(row): row for row in old["rows"]}
    speed = new["machine"]["dgemm_gflops"] / old["machine"]["dgemm_gflops"]
    found = []
    for row in new["rows"]:
        same = before.get(_identity(row))
        if same is None or not same.get("median") or not row.get("median"):
            continue
        ratio = row["median"] / same["median"]
        sizes = {key: value for key, value in row.items() if not _measured(key)}
        values = {"old": same["median"], "new": row["median"], "ratio": ratio, "per_gflop": ratio * speed}
        found.append(sizes | values)
    return sorted(found, key=lambda row: -row["ratio"])


def compared_markdown(old: Mapping, new: Mapping) -> str:
    """The same as a document, the medians of the ratios of every part first."""
    rows = compared(old, new)
    both = {"old": old, "new": new}
    lacking = [f"{name} is {missing(one)}" for name, one in both.items() if missing(one)]
    if not rows:
        raise DataError("; ".join(["the two measurements have no row in common", *lacking]))
    lines = [f"{name}: {described(one['machine'])}" for name, one in both.items()]
    lines += [*(f"{line}; rows that only one of the two has are left out" for line in lacking), ""]
    for part in dict.fromkeys(row["part"] for row in rows):
        ratios = np.array([row["ratio"] for row in rows if row["part"] == part])
        middle, low, high = np.quantile(ratios, [0.5, 0.05, 0.95])
        lines.append(
            f"{part}: new / old {middle:.2f} in the median of {len(ratios)} rows (90 %: {low:.2f} to {high:.2f})"
        )
    return "\n".join(lines) + "\n\n" + plain_markdown(rows)


def _identity(row: Row) -> tuple:
    return tuple(sorted((key, str(value)) for key, value in row.items() if not _measured(key)))


def _measured(key: str) -> bool:
    """Whether a column is a result; all others say what was measured. ``cost lorenz`` is one, as ``cost`` is."""
    return key.split()[0] in TIMES_OF + RESULTS


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)
