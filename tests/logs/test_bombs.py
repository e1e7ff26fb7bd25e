"""Small files that ask for all memory, or for hours, end in one line, soon."""

import json
import os
import struct
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pandas
import pytest
import yaml
import zstandard

sys.path.append(str(Path(__file__).resolve().parents[2]))
from gpmpc._bounds import MemoryBudget, memory_limit
from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, read_log
from gpmpc.logs._formats import read_file
from tests.logs import strange

ROOT = Path(__file__).resolve().parents[2]
CDR = b"\0\1\0\0"
CHUNK = 60_000_000  # [bytes] that a chunk may unfold to, whatever the file's size
FAN = "T{top} x\n" + "".join(
    f"===\nMSG: my/T{i}\n" + "".join(f"T{i - 1} a{j}\n" for j in range(10))
    for i in range(1, 10)
)
FAN += "===\nMSG: my/T0\nfloat64 y\n"


def bag_of_messages(data, definition="float64 angle", size=CHUNK, **options):
    """Writes a bag of one chunk that unfolds to less than the bound."""

    def write(path):
        return strange.bag_of_one_chunk(path, data, size, definition, **options)

    return write


def bag_of_records(records, encoding=b"cdr", content=None, size=None):
    """Writes a bag of one chunk of given records."""

    def write(path):
        header, head = strange.mcap_begin(encoding=encoding)
        body = head + records() if content is None else content
        packed = zstandard.compress(body)
        return strange.bag_of_chunk(path, header, packed, size or len(body))

    return write


def channels():
    return b"".join(
        strange.mcap_record(
            4,
            struct.pack("<HH", i % 65_536, 1)
            + strange.prefixed(b"/c%d" % i)
            + strange.prefixed(b"cdr")
            + strange.prefixed(b""),
        )
        for i in range(65_536)
    )


def json_messages(data):
    message = struct.pack("<HIQQ", 0, 0, 0, 0) + data
    records = strange.mcap_record(5, message)
    return bag_of_records(lambda: records * (CHUNK // len(records)), encoding=b"json")


def many_subscriptions(path):
    formats = strange.ulog_message(b"F", b"t4:uint64_t timestamp;float[4000] x;")
    formats += b"".join(
        strange.ulog_message(b"A", struct.pack("<BH", i % 256, i) + b"t4")
        for i in range(1, 8000)
    )
    return strange.ulog(path, {}, formats=formats)


BOMBS = {  # by the name of the file
    "zeros.npz": strange.npz_bomb,
    "a head that lies.npz": strange.npz_with_a_head_that_lies,
    "ten million columns.npz": strange.npz_of_many_columns,
    "constant columns.parquet": strange.parquet_bomb,
    "zeros.mat": strange.mat_bomb,
    "cells within cells.mat": strange.mat_of_nested_cells,
    "rows.csv.gz": strange.csv_bomb,
    "one line.csv.gz": strange.csv_of_one_line,
    "words.csv.gz": lambda path: strange.csv_bomb(path, b"0,a,b,c\n", 20_000_000),
    "a quote.csv.gz": lambda path: strange.csv_bomb(path, b'"a\n', 400_000_000),
    "one chunk.mcap": lambda path: strange.bag_of_one_chunk(path, CDR + bytes(8)),
    "messages.mcap": bag_of_messages(CDR + bytes(8)),
    "empty messages.mcap": bag_of_messages(b""),
    "lists of messages.mcap": bag_of_messages(
        CDR + struct.pack("<I", 2**20) + bytes(2**20), "E[] x\n===\nMSG: my/E\n"
    ),
    "lists of texts.mcap": bag_of_messages(
        CDR + struct.pack("<I", 2**18) + bytes(2**20), "string[] x"
    ),
    "an endless list.mcap": bag_of_messages(
        CDR + bytes(8), "E[1000000000] x\n===\nMSG: my/E\nfloat64[0] y\n"
    ),
    "a type of a billion fields.mcap": bag_of_messages(CDR, FAN.format(top=9)),
    "a type of a thousand fields.mcap": bag_of_messages(
        CDR + bytes(8000), FAN.format(top=3)
    ),
    "a type that holds itself.mcap": bag_of_messages(CDR + bytes(8), "Arm x"),
    "a list that holds itself.mcap": bag_of_messages(
        CDR + struct.pack("<I", 1) * 5000, "Arm[] x"
    ),
    "records of no kind.mcap": bag_of_records(
        lambda: strange.mcap_record(99, b"") * (CHUNK // 9)
    ),
    "channels.mcap": bag_of_records(channels),
    "a chunk that says less.mcap": bag_of_records(
        None, content=bytes(500_000_000), size=1000
    ),
    "deep json.mcap": json_messages(b'{"a":' * 100_000),
    "lists in json.mcap": json_messages(b'{"a":[' + b"[]," * 1_000_000 + b"[]]}"),
    "keys in json.mcap": json_messages(
        b"{" + b",".join(b'"k%d":1' % i for i in range(4000)) + b"}"
    ),
    "a number of 4000 digits in json.mcap": json_messages(
        b'{"a":' + b"9" * 4000 + b"}"
    ),
    "nested lists.ulg": strange.nested_ulog,
    "subscriptions.ulg": many_subscriptions,
    "no known message.ulg": lambda path: strange.ulog(
        path, {}, extra=struct.pack("<HB", 60_000, 1) * 300_000
    ),
}
COMMANDS = """
import json, os, resource, sys, time
from gpmpc.cli import main
import gpmpc.cli._learn, gpmpc.cli._log, gpmpc.plotting
import pyarrow.parquet, pyulog
pages = int(open("/proc/self/statm").read().split()[0])
most = pages * resource.getpagesize() + 500_000_000  # with what is loaded: 1 GB
for arguments in json.loads(sys.argv[1]):
    begin = time.monotonic()
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        os.dup2(os.open("errors", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.argv = ["gpmpc", *arguments]
        code = 1
        try:
            main()
            code = 0
        except SystemExit as error:
            code = error.code
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    seconds = time.monotonic() - begin
    print(json.dumps([arguments, code, seconds, open("errors").read()]), flush=True)
"""


def run_commands(commands, folder):
    """Runs command lines one after the other, with 500 MB for what they read each."""
    script = [sys.executable, "-c", COMMANDS, json.dumps(commands)]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    answer = subprocess.run(
        script, cwd=folder, env=os.environ | environment, capture_output=True, text=True
    )
    assert answer.returncode == 0, answer.stderr
    return [json.loads(line) for line in answer.stdout.splitlines()]


def mapping_of(name):
    if not name.endswith((".mcap", ".ulg")):
        return strange.TABLE_MAPPING
    topic = "/arm" if name.endswith(".mcap") else "t4"
    return {"rate": 50, "states": {"a": {"topic": topic, "columns": ["angle"]}}}


def test_every_bomb_ends_in_one_line_within_5_s_and_1_gb(tmp_path):
    commands = []
    inspected = set()  # endings: one of each, as both commands read alike
    for number, (name, write) in enumerate(BOMBS.items()):
        write(tmp_path / name)
        mapping = f"{number}.yaml"
        (tmp_path / mapping).write_text(yaml.safe_dump(mapping_of(name)))
        commands.append(["learn", mapping, name])
        if Path(name).suffix not in inspected:
            inspected.add(Path(name).suffix)
            commands.append(["log", "inspect", name])
    wrong = []
    for arguments, code, seconds, errors in run_commands(commands, tmp_path):
        is_one_line = errors.startswith("gpmpc: ") and errors.count("\n") == 1
        if code != 2 or seconds > 5 or not is_one_line or "memory" in errors.lower():
            wrong.append((arguments, code, seconds, errors))
    assert not wrong


@pytest.fixture
def table(tmp_path):
    strange.pendulum().to_csv(tmp_path / "arm.csv", index=False)
    return tmp_path / "arm.csv"


@pytest.mark.parametrize("rate", [1e9, 1e300])
def test_a_rate_that_asks_for_all_memory_is_refused(table, rate):
    with pytest.raises(DataError, match=r"rows of 3 columns at a rate of 1e\+\d+ Hz"):
        read_log(table, {**strange.TABLE_MAPPING, "rate": rate})


@pytest.mark.parametrize("rate", [1e-9, 5e-324])
def test_a_rate_that_leaves_one_row_is_refused(table, rate):
    with pytest.raises(DataError, match="leaves a single row"):
        read_log(table, {**strange.TABLE_MAPPING, "rate": rate})


def test_numbers_beyond_all_floats_are_refused(table):
    for key in ("rate", "max_gap"):
        with pytest.raises(SettingError, match="must be a number above 0"):
            read_log(table, {**strange.TABLE_MAPPING, key: 10**400})
    with pytest.raises(SettingError, match="keep.angle: must be two numbers"):
        read_log(table, {**strange.TABLE_MAPPING, "keep": {"angle": [10**400, None]}})


def test_a_huge_max_gap_over_a_jump_is_refused_by_name(tmp_path):
    table = strange.pendulum()
    table.loc[200:, "t"] += 864_000
    table.to_csv(tmp_path / "arm.csv", index=False)
    mapping = {**strange.TABLE_MAPPING, "rate": 50, "max_gap": 1e9}
    with pytest.raises(DataError, match=r"gaps of up to 1e\+09 s \(max_gap\)"):
        read_log(tmp_path / "arm.csv", mapping)


LAUGHS = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (LAUGHS, r"has an alias, \*a0"),
        ("states: &a [*a]", r"has an alias, \*a"),
        ("x: " + "[" * 30_000, "deeper than 10 levels"),
        ("rate: " + "9" * 5000, "cannot be read"),
        ("rate: 2001-99-99", "cannot be read"),
        ("x: " + "y" * 2**16, "more than 65536 characters"),
        ("states: {angle: {columns: [angle], unit: [1]}}", "must be a word"),
        ("states: {angle: [angle]}\nrun: [1]", "must be the name of a column"),
    ],
)
def test_a_mapping_that_never_ends_is_refused(tmp_path, text, expected):
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(SettingError, match=expected):
        LogMapping.load(tmp_path / "map.yaml")


def test_a_column_that_names_as_many_runs_as_rows_is_refused(tmp_path):
    rows = "".join(f"{k},{k % 7},{k % 5},{k % 3}\n" for k in range(5000))
    (tmp_path / "arm.csv").write_text("t,angle,rate,torque\n" + rows)
    with pytest.raises(DataError, match="names 5000 runs in 5000 rows"):
        read_log(tmp_path / "arm.csv", {**strange.TABLE_MAPPING, "run": "t"})


def test_a_text_that_stands_once_in_a_parquet_file_is_kept_once(tmp_path):
    path = strange.parquet_of_one_long_text(tmp_path / "arm.parquet", rows=100_000)
    tracemalloc.start()
    table = read_file(path).tables[""]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(table["note"].iloc[-1]) == 2**20
    assert peak < 50e6


@pytest.mark.parametrize("ending", ["csv.gz", "parquet", "npz"])
def test_honest_logs_that_compress_well_are_read(tmp_path, ending):
    table = strange.pendulum(20_000)
    zeros = {f"c{i}": np.zeros(len(table)) for i in range(40)}
    wide = pandas.concat([table, pandas.DataFrame(zeros)], axis=1)
    path = tmp_path / f"arm.{ending}"
    if ending == "csv.gz":
        wide.to_csv(path, index=False)
    elif ending == "parquet":
        wide.to_parquet(path, compression="zstd")
    else:
        np.savez_compressed(path, **{name: wide[name].to_numpy() for name in wide})
    assert len(read_log(path, strange.TABLE_MAPPING)) == len(table)


def test_what_is_no_column_of_an_archive_is_left_out_and_named(tmp_path):
    table = strange.pendulum()
    arrays = {name: table[name].to_numpy() for name in table}
    others = {"cube": np.zeros((2, 2, 2)), "flat": np.zeros((3, 1, 5000))}
    np.savez(tmp_path / "arm.npz", **arrays, **others, note="a flight")
    log = read_log(tmp_path / "arm.npz", strange.TABLE_MAPPING)
    (finding,) = log.findings
    assert (finding.kind, finding.count) == ("not read", 3)
    assert "cube, flat, note" in finding.text


def test_room_is_taken_before_it_is_used(tmp_path):
    path = tmp_path / "arm.csv"
    path.write_bytes(bytes(1000))
    left = MemoryBudget(path)
    assert left.size == memory_limit(path) == 64 * 2**20 + 300_000
    left.take(left.size, "a table")
    with pytest.raises(
        DataError, match="arm.csv: a row would take more than the 67 MB"
    ):
        left.take(1, "a row")
