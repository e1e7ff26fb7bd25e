"""Records of system identification open as they are published, by one mapping each."""

import gzip
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
import scipy.io
import yaml

from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, inspect_log, read_log

sys.path.append(str(Path(__file__).resolve().parents[2]))
from tests.cli.command import forked
from tests.logs.tables import read_file

ROWS = 240
STEP = 0.25


def record(seed=0, rows=ROWS):
    """An input and an output of a tank, rows of a constant step."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 3, rows // 6 + 1), 6)[:rows].round(4)
    y = np.zeros(rows)
    for k in range(rows - 1):
        y[k + 1] = y[k] + 0.2 * (u[k] - np.sqrt(max(y[k], 0)))
    return pandas.DataFrame({"u": u, "y": y.round(6)})


def mapping_of(u="u", y="y", **others):
    return {
        "time": {"step": STEP},
        "states": {"level": {"columns": [y], "unit": "V"}},
        "inputs": {"pump": {"columns": [u], "unit": "V"}},
        "rest": "use",
        **others,
    }


def daisy(folder):
    path = folder / "tank.dat"
    table = record().reset_index()
    path.write_text(
        "".join(f"{k:6.0f} {u:12.5e} {y:14.6e}\n" for k, u, y in table.to_numpy())
    )
    return path, mapping_of(u=2, y=3)


def trailing_comma(folder):
    path = folder / "SNLS80mV.csv"
    text = record().to_csv(index=False, header=["V1", "V2"])
    path.write_text(text.replace("\n", ",\n"))
    return path, mapping_of(u="V1", y="V2")


def side_by_side(folder):
    path = folder / "dataBenchmark.csv"
    table = pandas.concat(
        [record(0).add_suffix("Est"), record(1, 180).add_suffix("Val")], axis=1
    )[["uEst", "uVal", "yEst", "yVal"]]
    table["Ts"] = [STEP, *[None] * (ROWS - 1)]
    path.write_text(table.to_csv(index=False).replace("\n", ",\n"))
    runs = {
        "estimation": {"u": "uEst", "y": "yEst"},
        "validation": {"u": "uVal", "y": "yVal"},
    }
    return path, mapping_of(time={"step": "Ts"}, runs=runs)


def matlab(folder):
    path = folder / "dataBenchmark.mat"
    first = record(0)
    second = record(1, 180)
    content = {
        "uEst": first["u"].to_numpy()[None],
        "yEst": first["y"].to_numpy()[None],
        "uVal": second["u"].to_numpy()[:, None],
        "yVal": second["y"].to_numpy()[:, None],
        "Ts": STEP,
    }
    scipy.io.savemat(path, content, do_compression=True)
    return path, side_by_side(folder)[1]


def matlab_structure(folder):
    path = folder / "experiment.mat"
    table = record()
    data = {
        "u": table["u"].to_numpy()[:, None],
        "y": table["y"].to_numpy()[:, None],
        "Ts": STEP,
        "name": "tank",
    }
    scipy.io.savemat(path, {"data": data})
    return path, mapping_of(u="data.u", y="data.y", time={"step": "data.Ts"})


def simulink(folder):
    path = folder / "out.mat"
    u, y = record().to_numpy().T
    out = {"u": u[None, None], "y": y[None, :, None], "Ts": STEP}
    scipy.io.savemat(path, {"out": out})
    return path, mapping_of(u="out.u", y="out.y", time={"step": "out.Ts"})


def archive(folder):
    path = folder / "out.npz"
    u, y = record().to_numpy().T
    np.savez(path, u=u[None, None], y=y[None, :, None], Ts=STEP)
    return path, mapping_of(time={"step": "Ts"})


def tabs(folder):
    path = folder / "tank.txt"
    table = record()
    table.insert(0, "t", STEP * np.arange(ROWS))
    header = "Laboratory of tanks\nTime [s]\tPump\tLevel\n[s]\t[V]\t[V]\n"
    path.write_text(header + table.to_csv(index=False, header=False, sep="\t"))
    return path, mapping_of(u="Pump", y="Level", time="Time [s]")


def comments(folder):
    path = folder / "tank.asc.txt"
    lines = [f"{u} {y}" for u, y in record().to_numpy()]
    path.write_text("% measured in 1998\n# by hand\n" + "\n".join(lines) + "\n")
    return path, mapping_of(names=["u", "y"])


def fixed_width(folder):
    path = folder / "tank.dat.gz"
    table = record()
    table.insert(0, "y ", 0.0)
    text = table.set_axis(["y", "u", "y"], axis=1).to_string(index=False) + "\n"
    path.write_bytes(gzip.compress(text.encode()))
    return path, mapping_of(y="y (column 3)")


RECORDS = [
    daisy,
    trailing_comma,
    side_by_side,
    matlab,
    matlab_structure,
    simulink,
    archive,
    tabs,
    comments,
    fixed_width,
]


@pytest.mark.parametrize("write", RECORDS)
def test_a_published_record_is_inspected_and_read(tmp_path, write):
    path, mapping = write(tmp_path)
    bare = inspect_log(path)
    assert len(bare.channels) >= 2
    log = read_log(path, mapping)
    assert log.time_step == STEP
    expected = [record(0), record(1, 180)][: len(log.runs)]
    for run, table in zip(log.runs, expected, strict=True):
        np.testing.assert_allclose(run.inputs[:, 0], table["u"][: len(run)], atol=1e-4)
        np.testing.assert_allclose(run.states[:, 0], table["y"][: len(run)], atol=1e-4)
        assert len(run) >= len(table) - 1  # a last line without an end
        assert len(run.pieces) == 1
    inspection = inspect_log(path, LogMapping.from_dict(mapping))
    np.testing.assert_allclose(inspection.streams["rate [Hz]"], 1 / STEP)
    assert not [text for text in inspection.warnings if "cannot be learned" in text]


def test_runs_side_by_side_are_held_out_by_their_names(tmp_path):
    path, mapping = matlab(tmp_path)
    log = read_log(path, mapping)
    names = [run.name for run in log]
    assert names == ["dataBenchmark:estimation", "dataBenchmark:validation"]
    assert [len(run) for run in log] == [ROWS, 180]
    assert not log.findings
    assert log.space.names == ("y",)
    train, held_out = log.split(["dataBenchmark:validation"])
    assert (len(train), len(held_out)) == (ROWS, 180)
    hint = "Ts holds a single number, 0.25: if it is the time step, time: {step: Ts}"
    assert hint in inspect_log(path).warnings


def test_arrays_of_numpy_may_differ_in_length_as_well(tmp_path):
    table = record()
    arrays = {"u": table["u"], "y": table["y"], "late": table["y"][:90], "Ts": STEP}
    np.savez(tmp_path / "tank.npz", **arrays)
    log = read_log(tmp_path / "tank.npz", mapping_of(time={"step": "Ts"}))
    assert (len(log), log.time_step) == (ROWS, STEP)
    short = read_log(
        tmp_path / "tank.npz", mapping_of(y="late", runs={"a": {"u": "y"}})
    )
    assert len(short.runs[0]) == 90


def test_columns_by_number_are_called_as_their_signals(tmp_path):
    path, mapping = daisy(tmp_path)
    log = read_log(path, mapping)
    assert (log.space.names, log.input_names) == (("level",), ("pump",))
    mapping["states"] = {"both": [3, 1]}
    assert read_log(path, mapping).space.names == ("both_1", "both_2")
    assert "1 rises evenly, by 1: is it the time?" in inspect_log(path).warnings
    # A clock whose rows jitter, and pause once.
    jitter = np.random.default_rng(0).integers(-2, 3, ROWS)
    clock = 10 * np.arange(ROWS) + jitter + 100 * (np.arange(ROWS) > 30)
    jittering = record().assign(tempo=clock, way=np.cumsum(np.arange(ROWS) ** 2 + 1))
    jittering.to_csv(tmp_path / "jittering.csv", index=False)
    warnings = inspect_log(tmp_path / "jittering.csv").warnings
    assert "tempo rises in every row, by about 10: is it the time?" in warnings
    assert not any("way rises" in warning for warning in warnings)
    (tmp_path / "named.csv").write_text(record().to_csv(index=False))
    by_number = read_log(tmp_path / "named.csv", mapping_of(u=1, y=2))
    np.testing.assert_array_equal(by_number.runs[0].states[:, 0], record()["y"])
    with pytest.raises(DataError, match="column '4' is missing; it has 1, 2, 3"):
        read_log(path, mapping_of(u=2, y=4))


def test_a_single_number_may_be_the_rate_and_signals_may_be_rows(tmp_path):
    table = record()
    arrays = {"u": table["u"], "y": table["y"], "fs": 610.3515625, "Overload": 0}
    np.savez(tmp_path / "box.npz", **arrays)
    warnings = inspect_log(tmp_path / "box.npz").warnings
    hints = [warning for warning in warnings if "single number" in warning]
    assert hints == [
        "fs holds a single number, 610.352: if it is the time step, time: {step: fs}; "
        "if it is the rate in Hz, rate: 610.3515625"
    ]
    mapping = {**mapping_of(), "rate": 610.3515625}
    del mapping["time"]
    log = read_log(tmp_path / "box.npz", mapping)
    assert log.time_step == pytest.approx(1 / 610.3515625)
    table.T.to_csv(tmp_path / "lying.csv", index=False, header=False)
    (hint,) = [
        warning
        for warning in inspect_log(tmp_path / "lying.csv").warnings
        if "transpose" in warning
    ]
    assert hint.startswith(f"2 rows of {ROWS} columns: ")


def test_both_commands_take_the_rate_of_rows_without_stamps(tmp_path):
    record().to_csv(tmp_path / "tank.csv", index=False)
    mapping = mapping_of(time={}, rate=4)
    assert read_log(tmp_path / "tank.csv", mapping).time_step == STEP
    inspection = inspect_log(tmp_path / "tank.csv", LogMapping.from_dict(mapping))
    assert inspection.streams.loc[0, "rate [Hz]"] == 4
    slower = mapping_of(rate=2)
    assert len(read_log(tmp_path / "tank.csv", slower)) == ROWS // 2
    with pytest.raises(DataError, match=r"no column of stamps .* \{step: 0.1\}"):
        read_log(tmp_path / "tank.csv", mapping_of(time={}))
    in_ms = mapping_of(time={"step": 250, "unit": "ms"})
    assert read_log(tmp_path / "tank.csv", in_ms).time_step == STEP


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"time": {"step": 0}}, "time.step: must be a number above 0"),
        ({"time": {"step": 0.1, "column": "t"}}, "is for rows without stamps"),
        ({"names": "u y"}, "names: must be a list of names"),
        ({"names": ["u", "u"]}, "names: must be different names"),
        ({"runs": {"a": ["u"]}}, "runs.a: must be keys and values"),
        ({"runs": {"a": {"v": "u"}}}, "runs.a.v: is no column that the mapping uses"),
        ({"runs": {"a": {"u": [1]}}}, "runs.a.u: must be a column"),
        ({"runs": {"a": {"u": "x"}}, "run": "k"}, "runs: must stand alone"),
    ],
)
def test_a_wrong_way_of_saying_it_is_named(change, text):
    with pytest.raises(SettingError, match=text):
        LogMapping.from_dict(mapping_of(**change))


@pytest.mark.parametrize(
    ("text", "columns", "rows"),
    [
        ("0.0 1.0\n1.0 2.0\n", ["1", "2"], 2),
        ("  0.0\t 1.0\n  1.0\t 2.0\n", ["1", "2"], 2),
        ("-1,5 2,5\n1,5 2,5\n", ["1", "2"], 2),
        ("a;b\n1,5;2\n2;3,5\n", ["a", "b"], 2),
        ("t,a,b,\n0,1,2,\n1,2,3,\n", ["t", "a", "b"], 2),
        ("t,a,b\n0,1,2,\n1,2,3,\n", ["t", "a", "b"], 2),
        (",a,b\n0,1,2\n1,2,3\n", ["1", "a", "b"], 2),
        ("a,,b\n0,,2\n1,,3\n", ["a", "2", "b"], 2),
        ("t,a,t\n0,1,2\n", ["t (column 1)", "a", "t (column 3)"], 1),
        ("t,1,2\n0,1,2\n1,3,4\n", ["t", "1", "2"], 2),
        ("sep=;\nt;a\n0;1\n", ["t", "a"], 1),
        ("Tank\nTime (s)  Level (m)\n0.0 1.0\n", ["Time (s)", "Level (m)"], 1),
        ("Tank\nColumns: 1 input, 2 output\n0 1\n1 2\n2 3\n", ["1", "2"], 3),
        ("t,a\ns,V\n0,1\n1,2\n", ["t", "a"], 2),
        ("V,A\n0,1\n1,2\n", ["V", "A"], 2),
        ("a,b\n,\n0,1\n", ["a", "b"], 2),
        ('"a b" c\n0 1\n', ["a b", "c"], 1),
        ("u,y,Ts\n1,2,4\n1,2,\n", ["u", "y", "Ts"], 2),
    ],
)
def test_the_names_of_columns_are_found_or_their_numbers(tmp_path, text, columns, rows):
    (tmp_path / "a.txt").write_text(text)
    table = read_file(tmp_path / "a.txt").tables[""]
    assert list(table) == columns
    assert len(table) == rows
    assert set(table.dtypes.map(str)) <= {"int64", "float64"}


def test_matlab_files_that_hold_no_columns_say_why(tmp_path):
    scipy.io.savemat(
        tmp_path / "text.mat", {"note": "a tank", "cube": np.zeros((2, 2, 2))}
    )
    with pytest.raises(DataError, match=r"holds no rows \(note, cube: no columns"):
        read_file(tmp_path / "text.mat")
    (tmp_path / "cut.mat").write_bytes((tmp_path / "text.mat").read_bytes()[:150])
    with pytest.raises(DataError, match="cut.mat: cannot be read"):
        read_file(tmp_path / "cut.mat")


def test_objects_of_matlab_are_named_with_a_way_out(tmp_path, monkeypatch):
    scipy.io.savemat(tmp_path / "out.mat", {"y": np.arange(9.0)})
    fields = [(name, object) for name in ("s0", "s1", "s2", "arr")]
    opaque = np.array([(b"simout", b"MCOS", b"timeseries", None)], dtype=fields)
    monkeypatch.setattr(
        scipy.io, "loadmat", lambda path: {"None": opaque, "y": np.ones((9, 1))}
    )
    (finding,) = read_file(tmp_path / "out.mat").findings
    assert "simout (a timeseries object of MATLAB: save its numbers" in finding.text


@pytest.mark.parametrize("is_installed", [True, False])
def test_matlab_files_of_version_7_3_need_another_library(
    tmp_path, monkeypatch, is_installed
):
    path = tmp_path / "new.mat"
    table = record()
    if is_installed:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["u"] = table["u"].to_numpy()[None]  # as MATLAB stores a column
            file["data/y"] = table["y"].to_numpy()[None]
            file["note"] = np.array([[97, 98]], dtype=np.uint16)
            file["note"].attrs["MATLAB_class"] = np.bytes_("char")
        with path.open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(128))
        log = read_log(path, mapping_of(y="data.y"))
        np.testing.assert_array_equal(log.runs[0].states[:, 0], table["y"])
        (finding,) = log.findings
        assert "note: no columns" in finding.text
        return
    monkeypatch.setitem(sys.modules, "h5py", None)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(600))
    with pytest.raises(DataError, match="save it with '-v7' in MATLAB, or pip install"):
        read_file(path)


def test_the_command_opens_rows_without_times(tmp_path):
    path, mapping = daisy(tmp_path)
    result = forked("log", "inspect", path.name, "--time-step", "0.25", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "no line names the columns" in result.stdout
    assert "4" in result.stdout
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(mapping))
    both = ["--mapping", "map.yaml", "--time", "1"]
    wrong = forked("log", "inspect", path.name, *both, cwd=tmp_path)
    assert wrong.returncode == 2
    assert wrong.stderr == "gpmpc: time: must stand in the mapping where there is one\n"


def ramps(folder):
    """Ramps whose stamps are later than what was measured, by 0 to 3 rows."""
    time = 0.1 * np.arange(100)
    columns = {f"x{late}": time - 0.1 * late for late in range(4)}
    steps = {"u": np.floor(time), "gear": np.repeat(np.arange(10.0), 10)}
    path = folder / "ramps.csv"
    pandas.DataFrame({"t": time, **columns, **steps}).to_csv(path, index=False)
    return path


RAMPS = {
    "time": "t",
    "rest": "use",
    "states": {"x": {"columns": ["x0", "x1", "x3"], "delay": [0, 0.1, 0.3]}},
    "inputs": {"u": {"columns": ["u"]}},
}


@pytest.mark.parametrize("rate", [None, 10, 20])
def test_every_column_is_moved_back_by_its_delay(tmp_path, rate):
    log = read_log(ramps(tmp_path), {**RAMPS, "rate": rate})
    (run,) = log.runs
    np.testing.assert_allclose(run.states, run.time[:, None] * [1, 1, 1], atol=1e-9)
    assert run.time[-1] == pytest.approx(9.6)
    assert len(run) == {None: 97, 10: 97, 20: 193}[rate]


def test_every_signal_is_held_or_interpolated_as_it_says(tmp_path):
    states = {
        "x": {"columns": ["x0"]},
        "gear": {"columns": ["gear"], "resample": "hold"},
    }
    inputs = {"u": {"columns": ["x1"], "resample": "linear"}, "step": ["x2"]}
    log = read_log(
        ramps(tmp_path), {**RAMPS, "rate": 20, "states": states, "inputs": inputs}
    )
    (run,) = log.runs
    np.testing.assert_allclose(run.states[:, 0], run.time, atol=1e-9)
    np.testing.assert_allclose(run.inputs[:, 0], run.time - 0.1, atol=1e-9)
    assert set(run.states[:, 1]) == set(range(10))
    np.testing.assert_allclose(run.inputs[1::2, 1], run.inputs[0:-1:2, 1])


def test_a_signal_says_whether_its_repeated_samples_are_taken(tmp_path):
    states = {"x": ["x0", "x1"], "gears": ["gear", "u"]}
    path = ramps(tmp_path)
    with pytest.raises(DataError, match="gears changes in 10 of 100 rows only"):
        read_log(path, {**RAMPS, "states": states, "inputs": {"v": ["x3"]}})
    states["gears"] = {"columns": ["gear", "u"], "held": "use"}
    log = read_log(path, {**RAMPS, "states": states, "inputs": {"v": ["x3"]}})
    assert len(log) == 100
    assert {one.kind for one in log.findings} == {"copied state"}  # all are ramps


@pytest.mark.parametrize(
    ("signal", "text"),
    [
        ({"delay": [0.1]}, "states.x.delay: must be a list of 3 numbers"),
        ({"delay": "late"}, "states.x.delay: must be a number"),
        ({"resample": "spline"}, "states.x.resample"),
        ({"held": "maybe"}, "states.x.held"),
    ],
)
def test_a_wrong_rule_of_a_signal_is_named(signal, text):
    entry = {"columns": ["x0", "x1", "x3"], **signal}
    with pytest.raises(SettingError, match=text):
        LogMapping.from_dict({**RAMPS, "states": {"x": entry}})
    attitude = {"columns": list("abcd"), "kind": "quaternion", "delay": [0, 0, 0, 1]}
    with pytest.raises(SettingError, match="must be one number for an attitude"):
        LogMapping.from_dict({**RAMPS, "states": {"x": attitude}})


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("LOG00001.BBL", "blackbox_decode makes .csv"),
        ("00000012.BIN", "mavlogdump.py --format csv"),
        ("flight.tlog", "mavlogdump.py --format csv"),
        ("flight.log", "rename other texts to .txt"),
        ("flight.bag.active", "rosbag reindex finishes it"),
        ("tank.xlsx", "a spreadsheet: save it as .csv"),
        ("tank.xyz", "unknown kind of file; known are .csv"),
    ],
)
def test_what_is_not_read_says_what_makes_it_readable(tmp_path, name, text):
    (tmp_path / name).write_bytes(bytes(100))
    with pytest.raises(DataError, match=text):
        read_file(tmp_path / name)


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("loopIteration, time (us), gyroADC[0], motor[0]", 1e6),  # blackbox_decode
        ("timestamp,TimeUS,Roll,Pitch", 1.0),  # mavlogdump.py
        ("LineNo,TimeUS,Roll,Pitch", 1e6),
        ("n;Time [ms];a;b", 1e3),
        ("n t_s a b", 1.0),
    ],
)
def test_files_of_converters_are_inspected_over_their_times(tmp_path, header, unit):
    mark = next(mark for mark in ",; " if mark in header)
    time = 1e-2 * np.arange(50)
    first = time if header.startswith("timestamp") else np.arange(50)
    table = np.column_stack([first, time * unit, np.sin(time), np.cos(time)])
    rows = "\n".join(mark.join(f"{value:.9g}" for value in row) for row in table)
    (tmp_path / "log.csv").write_text(f"{header}\n{rows}\n")
    inspection = inspect_log(tmp_path / "log.csv")
    assert inspection.streams.loc[0, "rate [Hz]"] == pytest.approx(100)
