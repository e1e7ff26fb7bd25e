"""Two hundred strange logs: each is refused in one line, noted, or read as what it was.

Three flights are spoiled in forty ways, four times each with another seed, the later
two slow, and in a few more ways once. They are simulated; where ``GPMPC_FLIGHTS`` names
a folder of real ones, three of those.
"""

import gzip
import os
import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pandas
import pytest

from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.logs import LogMapping, inspect_log, read_log

ROOT = Path(__file__).resolve().parents[2]
SEEDS = range(4)
FAST = 2  # seeds that every run of the tests takes; -m slow takes the others
REAL = ("B2_circle_fast_rep2", "B3_figure8_fast_rep1", "B3_figure8_medium_rep2")
STATES = ["px", "py", "pz", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz"]
MAPPING = {
    "time": "t",
    "model": "rigid_body",
    "max_gap": 0.03,
    "states": {
        "position": {"columns": STATES[:3], "unit": "m"},
        "attitude": {"columns": STATES[3:7], "kind": "quaternion", "order": "xyzw"},
        "velocity": {"columns": STATES[7:10], "unit": "m/s", "frame": "world"},
        "rate": {"columns": STATES[10:], "unit": "rad/s", "frame": "body"},
    },
    "inputs": {"motors": {"columns": ["m1", "m2", "m3", "m4"]}},
}


@cache
def flights():
    """Three flights without a fault, of the columns of the mapping."""
    if folder := os.environ.get("GPMPC_FLIGHTS"):
        tables = [pandas.read_csv(Path(folder) / f"{name}.csv.gz") for name in REAL]
        rates = {f"w{axis}_vicon": f"w{axis}" for axis in "xyz"}
        motors = {f"motor_motor_m{i}": f"m{i}" for i in range(1, 5)}
        columns = ["t", *STATES, *motors.values()]
        return [
            table.rename(columns=rates | motors)[columns][300:1500].reset_index(
                drop=True
            )
            for table in tables
        ]
    example = runpy.run_path(str(ROOT / "examples" / "own_log.py"))
    return example["simulate_flights"](3, 800)


def some_rows(table, rng, count):
    """Rows of a stretch somewhere in the middle of a table."""
    begin = int(rng.integers(100, len(table) - 100 - count))
    return range(begin, begin + count)


def one_of(rng, values):
    return values[int(rng.integers(len(values)))]


def set_values(columns, value, count):
    """Sets some rows of one of the columns to a value."""

    def spoil(table, rng):
        column = one_of(rng, columns)
        table[column] = table[column].astype(float)
        table.loc[some_rows(table, rng, count), column] = value
        return table

    return spoil


def scale(columns, factor):
    return lambda table, rng: table.assign(**{c: factor * table[c] for c in columns})


def rename(names):
    return lambda table, rng: table.rename(columns=names)


def late(columns, rows):
    return lambda table, rng: table.assign(
        **{c: table[c].shift(rows) for c in columns}
    )[rows:]


def flip_one(columns):
    def spoil(table, rng):
        column = one_of(rng, columns)
        return table.assign(**{column: -table[column]})

    return spoil


def scale_one(columns, factor):
    def spoil(table, rng):
        column = one_of(rng, columns)
        return table.assign(**{column: factor * table[column]})

    return spoil


def jump_stamps(seconds):
    def spoil(table, rng):
        row = int(rng.integers(100, len(table) - 100))
        return table.assign(t=table["t"] + np.where(table.index >= row, seconds, 0.0))

    return spoil


def stamps_of_another_clock(table, rng):
    return table.assign(t=table["t"] - np.where(np.arange(len(table)) < 50, 1.6e9, 0))


def last_stamp_of_another_age(table, rng):
    table.loc[table.index[-1], "t"] = 2147483647.0
    return table


def swap_rows(table, rng):
    rows = np.arange(len(table))
    begin = some_rows(table, rng, 20)[0]
    rows[begin : begin + 20] = rows[begin : begin + 20][::-1]
    return table.iloc[rows]


def repeat_stamps(table, rng):
    for row in some_rows(table, rng, 5):
        table.loc[row, "t"] = table.loc[row - 1, "t"]
    return table


def hold(columns, count):
    def spoil(table, rng):
        rows = some_rows(table, rng, count)
        table.loc[rows, columns] = table.loc[rows[0], columns].to_numpy(dtype=float)
        return table

    return spoil


def drop_rows(table, rng):
    return table.drop(index=some_rows(table, rng, 30))


def north_east_down(table, rng):
    """The same flight with z downwards, in the world and in the body."""
    signs = {"py": -1, "pz": -1, "vy": -1, "vz": -1, "wy": -1, "wz": -1}
    signs |= {"qy": -1, "qz": -1}
    return table.assign(
        **{column: sign * table[column] for column, sign in signs.items()}
    )


#: what is done to a table, where the reader has to refuse or note it
NOTICED = {
    "quaternion in the other order": rename(
        {"qx": "qw", "qy": "qx", "qz": "qy", "qw": "qz"}
    ),
    "rates in other axes": scale(["wy", "wz"], -1),
    "velocity downwards": scale(["vz"], -1),
    "one velocity flipped": flip_one(["vx", "vy"]),
    "one rate flipped": flip_one(["wx", "wy"]),
    "x and y swapped": rename({"vx": "vy", "vy": "vx"}),
    "one rate in degrees": scale_one(["wx", "wy"], 57.3),
    "velocity in mm/s": scale(["vx", "vy", "vz"], 1000),
    "velocity in ft/s": scale(["vx", "vy", "vz"], 3.28),
    "attitude late": late(["qx", "qy", "qz", "qw"], 20),
    "a whole flight downwards": north_east_down,
    "a sentinel in a state": set_values(["px", "vy", "wz"], -9999, 3),
    "a huge sentinel": set_values(["m1", "pz"], 1e30, 2),
    "missing values": set_values(STATES, np.nan, 10),
    "infinite values": set_values(STATES, np.inf, 1),
    "zeros for all states": lambda table, rng: table.assign(
        **{c: np.where(table.index < 20, 0, table[c]) for c in STATES}
    ),
    "stamps that jump by ten days": jump_stamps(864000.0),
    "stamps that jump back": jump_stamps(-864000.0),
    "stamps of another clock": stamps_of_another_clock,
    "a last stamp of another age": last_stamp_of_another_age,
    "rows in another order": swap_rows,
    "stamps that repeat": repeat_stamps,
    "a stamp that is missing": set_values(["t"], np.nan, 1),
    "a position that is held": hold(["px", "py", "pz"], 30),
    "one axis that is held": hold(["px"], 60),
    "all states that are held": hold(STATES, 40),
    "missing rows": drop_rows,
    "a missing column": lambda table, rng: table.drop(columns=one_of(rng, STATES)),
    "text in a column": lambda table, rng: table.assign(px="here"),
    "a constant input": lambda table, rng: table.assign(m1=1, m2=1, m3=1, m4=1),
    "no value in a column": lambda table, rng: table.assign(vx=np.nan),
    "no row": lambda table, rng: table[:0],
    "one row": lambda table, rng: table[:1],
}


def cut_text(content, rng):
    return content[: int(rng.integers(len(content) // 2, len(content)))].rstrip(b"\n")


def flip_bytes(content, rng):
    spoiled = bytearray(content)
    for position in rng.integers(0, len(spoiled), 3):
        spoiled[position] ^= 1 << int(rng.integers(8))
    return bytes(spoiled)


#: what is done to the text of a file, where it has to be refused or noted
SPOILED_TEXT = {
    "cut in the middle": cut_text,
    "a letter in a number": lambda text, rng: text.replace(b".", b".o", 100),
    "a header in another encoding": lambda text, rng: b"\xb0," + text,
    "a decimal comma": lambda text, rng: text.replace(b".", b","),
    "a packed file that is cut": lambda text, rng: gzip.compress(text)[:-500],
    "nothing": lambda text, rng: b"",
    "a line without an end": lambda text, rng: text[:-3],
}
#: what is done to the text of a file, where it is read as it was
SAME = {
    "semicolons and decimal commas": lambda text, rng: text.replace(b",", b";").replace(
        b".", b","
    ),
    "UTF-16": lambda text, rng: text.decode().encode("utf-16"),
    "comments": lambda text, rng: b"# flown on a Tuesday\n" + text,
    "a commented header": lambda text, rng: b"# " + text,
    "lines that end as on Windows": lambda text, rng: text.replace(b"\n", b"\r\n"),
    "a mark of UTF-8": lambda text, rng: b"\xef\xbb\xbf" + text,
}
STRANGE_MAPPINGS = {
    "a rate of a gigahertz": {"rate": 1e9},
    "a rate of a millihertz": {"rate": 1e-3},
    "no gap at all": {"max_gap": 1e-9},
    "nothing kept": {"keep": {"px": [1e6, None]}},
}


def is_said(read):
    """Reads a log; returns whether it is refused, in one line, or something is said."""
    try:
        log = read()
    except GpmpcError as error:
        refusal = str(error)
    else:
        assert all(np.isfinite(run.states).all() for run in getattr(log, "runs", ()))
        return bool(getattr(log, "findings", ()))
    assert "\n" not in refusal
    return True


def check_outcome(path, mapping):
    """Reads a log and inspects it; returns whether something was said of it."""
    is_said(lambda: inspect_log(path))
    return is_said(lambda: read_log(path, mapping))


def trials(names):
    """Every way with every seed, the later ones slow."""
    return [
        pytest.param(name, seed, marks=[pytest.mark.slow] if seed >= FAST else [])
        for name in names
        for seed in SEEDS
    ]


def flight_of(seed):
    return flights()[seed % 3].copy()


@pytest.mark.parametrize("flight", range(3))
def test_a_flight_without_a_fault_is_read_without_a_finding(tmp_path, flight):
    flights()[flight].to_csv(tmp_path / "log.csv", index=False)
    assert not check_outcome(tmp_path / "log.csv", MAPPING)


@pytest.mark.parametrize(("name", "seed"), trials(NOTICED))
def test_a_contradiction_is_refused_or_noted(tmp_path, name, seed):
    spoiled = NOTICED[name](flight_of(seed), np.random.default_rng(seed))
    spoiled.to_csv(tmp_path / "log.csv", index=False)
    assert check_outcome(tmp_path / "log.csv", MAPPING)


@pytest.mark.parametrize(("name", "seed"), trials(SPOILED_TEXT))
def test_spoiled_text_is_refused_or_noted(tmp_path, name, seed):
    text = flight_of(seed).to_csv(index=False).encode()
    content = SPOILED_TEXT[name](text, np.random.default_rng(seed))
    ending = ".csv.gz" if content.startswith(b"\x1f\x8b") else ".csv"
    (tmp_path / f"log{ending}").write_bytes(content)
    assert check_outcome(tmp_path / f"log{ending}", MAPPING)


@pytest.mark.parametrize("seed", range(12))
def test_flipped_bits_in_the_text_raise_nothing_strange(tmp_path, seed):
    text = flight_of(seed).to_csv(index=False).encode()
    (tmp_path / "log.csv").write_bytes(flip_bytes(text, np.random.default_rng(seed)))
    check_outcome(tmp_path / "log.csv", MAPPING)


@pytest.mark.parametrize("name", SAME)
def test_another_way_of_writing_gives_the_same_log(tmp_path, name):
    text = flight_of(0).to_csv(index=False).encode()
    (tmp_path / "log.csv").write_bytes(text)
    (tmp_path / "other.csv").write_bytes(SAME[name](text, None))
    expected = read_log(tmp_path / "log.csv", MAPPING)
    other = read_log(tmp_path / "other.csv", MAPPING)
    assert other.findings == ()
    np.testing.assert_array_equal(other.runs[0].states, expected.runs[0].states)


@pytest.mark.parametrize("unit", ["ns", "us", 1e-12])
def test_a_time_in_another_unit_is_noted(tmp_path, unit):
    table = flight_of(0)
    if unit == 1e-12:
        table = table.assign(t=unit * table["t"])
        time = "t"
    else:
        time = {"column": "t", "unit": unit}
    table.to_csv(tmp_path / "log.csv", index=False)
    states = {"position": MAPPING["states"]["position"]}
    log = read_log(
        tmp_path / "log.csv",
        {"time": time, "states": states, "inputs": MAPPING["inputs"]},
    )
    assert "is the unit of the time right" in log.findings[0].text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("keep: 3", "keep: must be keys and values"),
        ("keep: [a]", "keep: must be keys and values"),
        ("keep: {pz: [.nan, 1]}\nstates: {z: [pz]}", "keep.pz: must be two numbers"),
        ("states: {z: {columns: 1.5}}", "states.z.columns: must be a name, or a list"),
        ("states: {z: {columns: {pz: 1}}}", "states.z.columns: must be a name, or"),
        ("states: {z: {columns: 2024-01-01}}", "states.z.columns: must be a name"),
        ("time: t\ntime: s", "mapping: holds the key 'time' twice"),
    ],
)
def test_a_mapping_that_is_no_mapping_is_refused(tmp_path, text, reason):
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(SettingError, match=reason):
        LogMapping.load(tmp_path / "map.yaml")


@pytest.mark.parametrize("name", STRANGE_MAPPINGS)
def test_a_strange_mapping_is_refused_or_noted(tmp_path, name):
    flight_of(0).to_csv(tmp_path / "log.csv", index=False)
    assert check_outcome(tmp_path / "log.csv", MAPPING | STRANGE_MAPPINGS[name])
