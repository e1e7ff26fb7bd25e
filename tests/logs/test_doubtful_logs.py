"""Logs that could be taken for what they are not are refused, noted or read right."""

import numpy as np
import pandas
import pytest

from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, inspect_log, read_log

MAPPING = {"time": "t", "states": {"x": ["x"]}, "inputs": {"u": ["u"]}}


def table_of(rows=300, step=0.1):
    k = np.arange(rows)
    return pandas.DataFrame(
        {"t": step * k, "x": np.sin(0.07 * k), "u": np.cos(0.05 * k)}
    )


def written(folder, table, name="log.csv"):
    table.to_csv(folder / name, index=False)
    return folder / name


def texts(log, kind):
    return [finding.text for finding in log.findings if finding.kind == kind]


@pytest.mark.parametrize("step", [0.14, 0.2])
def test_runs_of_unlike_steps_are_refused(tmp_path, step):
    files = [
        written(tmp_path, table_of(2000), "a.csv"),
        written(tmp_path, table_of(800, step), "b.csv"),
    ]
    rule = f"run b: rows are {step} s apart, those of other runs 0.1 s.*rate: "
    with pytest.raises(DataError, match=rule + f"{1 / step:.3g}"):
        read_log(files, MAPPING)
    log = read_log(files, {**MAPPING, "rate": 1 / step})
    assert len(log.runs) == 2
    assert log.time_step == pytest.approx(step)


def test_steps_that_a_column_says_are_compared_as_well(tmp_path):
    files = []
    for name, step in (("a", 0.1), ("b", 0.14)):
        table = table_of().drop(columns="t").assign(Ts=step)
        files.append(written(tmp_path, table, f"{name}.csv"))
    with pytest.raises(DataError, match="a log has one time step"):
        read_log(files, {**MAPPING, "time": {"step": "Ts"}})


def test_rounded_stamps_of_one_clock_are_like_steps(tmp_path):
    files = []
    for name, begin in (("a", 0.0), ("b", 0.017)):
        table = table_of(401, 0.025)
        stamps = np.round(begin + table["t"] + 1e-9, 2)
        files.append(written(tmp_path, table.assign(t=stamps), f"{name}.csv"))
    assert len(read_log(files, MAPPING).runs) == 2


def test_steps_that_vary_are_noted(tmp_path):
    table = table_of(step=0.01)
    table["t"] += np.random.default_rng(0).uniform(-0.002, 0.002, 300)
    (text,) = texts(read_log(written(tmp_path, table), MAPPING), "jitter")
    assert text.startswith("steps from row to row vary by 18% of the time step")
    assert text.endswith("s each (a rate resamples)")
    even = read_log(written(tmp_path, table_of()), MAPPING)
    assert not texts(even, "jitter")


def test_a_state_measured_less_often_than_the_rate_is_noted(tmp_path):
    table = table_of(2000, 0.01)
    table["x"] = table["x"].where(np.arange(2000) % 20 == 0)
    log = read_log(written(tmp_path, table), {**MAPPING, "rate": 100, "max_gap": 0.3})
    (text,) = texts(log, "interpolated")
    assert text.startswith("x is measured at 5 Hz: about 95% of its rows")
    slow = read_log(tmp_path / "log.csv", {**MAPPING, "rate": 5, "max_gap": 0.3})
    assert not texts(slow, "interpolated")


@pytest.mark.parametrize(
    ("name", "factor"), [("t_ms", 1e3), ("time (us)", 1e6), ("TimeUS", 1e6)]
)
def test_the_name_of_a_time_says_its_unit(tmp_path, name, factor):
    table = table_of().rename(columns={"t": name})
    table[name] *= factor
    path = written(tmp_path, table)
    assert read_log(path, {**MAPPING, "time": name}).time_step == pytest.approx(0.1)
    rates = inspect_log(path, time=name).streams["rate [Hz]"]
    assert rates[0] == pytest.approx(10)


def test_microseconds_that_nobody_stated_are_refused(tmp_path):
    table = table_of(step=0.004).rename(columns={"t": "timestamp"})
    table["timestamp"] = (1e6 * table["timestamp"]).round().astype(int)
    path = written(tmp_path, table)
    mapping = {key: MAPPING[key] for key in ("states", "inputs")}
    with pytest.raises(DataError, match="rows are 4e.03 s apart if timestamp is in s"):
        read_log(path, mapping)
    stated = read_log(path, {**mapping, "time": {"unit": "us"}})
    assert stated.time_step == pytest.approx(0.004)


@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_dates_in_a_text_are_times(tmp_path, zone):
    table = table_of()
    dates = pandas.Timestamp("2024-05-01 12:00") + pandas.to_timedelta(table.t, "s")
    table["t"] = [f"{date}{zone}" for date in dates]
    path = written(tmp_path, table)
    log = read_log(path, MAPPING)
    assert log.time_step == pytest.approx(0.1)
    assert len(log) == 300
    rates = inspect_log(path, time="t").streams["rate [Hz]"]
    assert rates[0] == pytest.approx(10)


def test_dates_that_may_be_mistaken_are_refused_with_a_way_out(tmp_path):
    table = table_of().assign(t="01.05.2024 12:00")
    with pytest.raises(DataError, match=r"2024-05-01 12:00:00.*time: \{step"):
        read_log(written(tmp_path, table), MAPPING)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_lines_of_an_instrument_are_no_rows(tmp_path, delimiter):
    lines = ["Sampling rate,100", "Device,X", table_of().to_csv(index=False)]
    text = "\n".join(lines).replace(",", delimiter)
    (tmp_path / "log.csv").write_text(text)
    log = read_log(tmp_path / "log.csv", MAPPING)
    np.testing.assert_array_equal(log.runs[0].states[:, 0], table_of()["x"])


def test_numbers_that_pandas_writes_above_rows_are_no_row(tmp_path):
    table = table_of()
    pandas.DataFrame(table.to_numpy()).to_csv(tmp_path / "log.csv")
    mapping = {"time": 2, "states": {"x": [3]}, "inputs": {"u": [4]}}
    log = read_log(tmp_path / "log.csv", mapping)
    assert len(log) == len(table)


QUATERNION = {
    "time": "t",
    "rest": "use",
    "held": "use",
    "states": {"attitude": {"columns": ["a", "b", "c", "d"], "kind": "quaternion"}},
    "inputs": {"u": ["u"]},
}


def attitudes():
    angles = 0.01 * np.arange(300)
    entries = {"a": np.sin(angles), "b": 0.0, "c": 0.0, "d": np.cos(angles)}
    return table_of().assign(**entries)


def test_zeros_before_an_estimator_begins_are_no_attitude(tmp_path):
    table = attitudes()
    table.loc[:19, ["a", "b", "c", "d"]] = 0.0
    log = read_log(written(tmp_path, table), QUATERNION)
    assert len(log) == 280
    assert "20 samples of attitude are zeros" in texts(log, "empty sample")[0]


def test_rows_outside_of_keep_may_be_wrong(tmp_path):
    table = attitudes()
    table.loc[:19, "a"] = 7.0
    path = written(tmp_path, table)
    with pytest.raises(DataError, match="in row 1 has norm"):
        read_log(path, QUATERNION)
    assert len(read_log(path, {**QUATERNION, "keep": {"t": [2.0, None]}})) == 280


def test_rows_without_a_time_are_left_out(tmp_path):
    table = table_of()
    table.loc[100:109, "t"] = np.nan
    log = read_log(written(tmp_path, table), MAPPING)
    assert len(log) == 290
    assert log.runs[0].begins == (0, 100)
    assert texts(log, "no stamp") == ["10 rows without a time: left out"]


def test_a_vehicle_that_stops_at_once_may_be_learned_from(tmp_path):
    k = np.arange(300)
    table = table_of().assign(
        v=np.where(k % 60 < 40, 0.5 + 0.01 * np.sin(k), 0.0),
        w=np.where(k % 60 < 40, 0.1 + 0.01 * np.cos(k), 0.0),
    )
    mapping = {**MAPPING, "states": {"v": ["v"], "w": ["w"]}, "rest": "use"}
    path = written(tmp_path, table)
    assert texts(read_log(path, mapping), "all zero")
    assert len(read_log(path, {**mapping, "held": "use"})) == 300


def test_quantities_of_unlike_size_in_one_signal_are_noted(tmp_path):
    table = table_of().assign(p=1e5 * np.sin(0.03 * np.arange(300)))
    path = written(tmp_path, table)
    together = read_log(path, {**MAPPING, "states": {"y": ["x", "p"]}})
    (text,) = texts(together, "unlike entries")
    assert "x hardly counts; name a signal for each quantity" in text
    apart = read_log(path, {**MAPPING, "states": {"x": ["x"], "p": ["p"]}})
    assert not texts(apart, "unlike entries")


def test_rounded_stamps_are_named_where_many_repeat(tmp_path):
    table = table_of(step=0.0025)
    table["t"] = table["t"].round(2)
    (text,) = texts(read_log(written(tmp_path, table), MAPPING), "repeated stamp")
    assert "are the stamps rounded?" in text


def test_samples_a_tenth_of_a_microsecond_apart_are_told_apart(tmp_path):
    table = table_of(step=1e-7)
    mapping = {**MAPPING, "rate": 1e7, "max_gap": 1e-6, "rest": "use"}
    log = read_log(written(tmp_path, table), mapping)
    inputs = log.runs[0].inputs[:, 0]
    np.testing.assert_array_equal(inputs[:290], table["u"][:290])


def test_row_vectors_are_columns(tmp_path):
    table = table_of()
    arrays = {name: table[name].to_numpy()[None] for name in table}
    np.savez(tmp_path / "log.npz", **arrays)
    log = read_log(tmp_path / "log.npz", MAPPING)
    np.testing.assert_array_equal(log.runs[0].states[:, 0], table["x"])


@pytest.mark.parametrize("is_stacked", [False, True])
def test_rows_of_one_stamp_with_different_signals_are_one_row(tmp_path, is_stacked):
    table = table_of()
    rows = pandas.concat([table[["t", "x"]], table[["t", "u"]]])
    if not is_stacked:
        rows = rows.sort_values("t", kind="stable")
    (run,) = read_log(written(tmp_path, table, "whole.csv"), MAPPING)
    log = read_log(written(tmp_path, rows), MAPPING)
    np.testing.assert_array_equal(log.runs[0].states, run.states)
    np.testing.assert_array_equal(log.runs[0].inputs, run.inputs)
    assert [finding.kind for finding in log.findings] == ["rows of one stamp"]
    contradicting = pandas.concat([table, table[["t", "x"]] + [0.0, 0.1]])
    path = written(tmp_path, contradicting.sort_values("t", kind="stable"))
    log = read_log(path, MAPPING)
    np.testing.assert_array_equal(log.runs[0].states, run.states)
    assert [finding.kind for finding in log.findings] == ["repeated stamp"]


def test_rows_of_one_stamp_after_a_clock_began_anew_are_others(tmp_path):
    table = table_of()
    streams = []
    for name in ("x", "u"):
        streams.append(table[["t", name]].assign(t=table["t"].round(1)))
    boot = pandas.concat(streams).sort_values("t", kind="stable")
    later_boot = boot.assign(x=boot["x"] + 2.0, u=boot["u"] + 2.0)[::-1]
    later_boot = later_boot.sort_values("t", kind="stable")
    path = written(tmp_path, pandas.concat([boot, later_boot]))
    (run,) = read_log(path, {**MAPPING, "max_gap": 300.0})
    first = slice(0, 300)
    later = slice(300, 600)
    np.testing.assert_array_equal(run.states[first, 0], table["x"])
    np.testing.assert_array_equal(run.inputs[first, 0], table["u"])
    np.testing.assert_array_equal(run.states[later, 0], table["x"] + 2.0)
    np.testing.assert_array_equal(run.inputs[later, 0], table["u"] + 2.0)
    assert run.time[300] - run.time[299] > 300.0


def test_a_column_of_times_without_a_time_is_named(tmp_path):
    table = table_of().assign(t=np.nan)
    table.loc[1, "u"] = np.nan
    with pytest.raises(DataError, match="the time in row 1 is nan"):
        read_log(written(tmp_path, table), MAPPING)


def test_streams_with_rows_of_their_own_need_a_rate(tmp_path):
    fast = table_of()[["t", "x"]]
    slow = pandas.DataFrame({"t": 0.03 + 0.5 * np.arange(60)})
    slow["p"] = np.sin(0.2 * slow["t"])
    inputs = pandas.DataFrame({"t": 0.01 + 0.3 * np.arange(100), "u": np.arange(100)})
    table = pandas.concat([fast, slow, inputs]).sort_values("t")
    path = written(tmp_path, table)
    mapping = {**MAPPING, "states": {"x": ["x"], "p": ["p"]}}
    rule = "no row has a value of every signal: of 460 rows, x in 300, p in 60, u in"
    with pytest.raises(DataError, match=f"{rule} 100; state a rate"):
        read_log(path, mapping)
    log = read_log(path, {**mapping, "rate": 10})
    (run,) = log
    assert len(run) >= 290
    expected = np.interp(run.time, slow["t"], slow["p"])
    np.testing.assert_allclose(run.states[:, 1], expected, atol=1e-9)
    samples = np.searchsorted(inputs["t"], run.time + 1e-6, side="right") - 1
    np.testing.assert_array_equal(run.inputs[:, 0], inputs["u"].to_numpy()[samples])
    assert len(texts(log, "interpolated")) == 1
    path = written(tmp_path, table.assign(u=np.nan))
    with pytest.raises(DataError, match="u in 0; name columns that hold values"):
        read_log(path, mapping)
    with pytest.raises(DataError, match="u in 0; state a longer max_gap"):
        read_log(path, {**mapping, "rate": 10})


def fast_table(held_for):
    """Returns 10 s at 1 kHz of a system of gain 5 whose input switches at random."""
    switches = np.random.default_rng(0).choice([-1.0, 1.0], 10_000 // held_for)
    inputs = np.repeat(switches, held_for)
    states = np.zeros(10_000)
    for k, u in enumerate(inputs[:-1]):
        states[k + 1] = states[k] + 0.001 * (5 * u - 2 * states[k])
    return pandas.DataFrame({"t": 0.001 * np.arange(10_000), "x": states, "u": inputs})


def test_an_input_that_changes_between_rows_is_averaged(tmp_path):
    table = fast_table(held_for=1).drop(index=range(4000, 4500))
    path = written(tmp_path, table)
    log = read_log(path, {**MAPPING, "rate": 50})
    (text,) = texts(log, "averaged input")
    assert text.startswith("u changes between rows, 20 samples to each: a row has the")
    pairs = log.windows(1)
    features = np.hstack([pairs.states[:, 0], pairs.inputs[:, 0]])
    rates = 50 * (pairs.states[:, 1] - pairs.states[:, 0])
    gains = np.linalg.lstsq(features, rates, rcond=None)[0].ravel()
    np.testing.assert_allclose(gains, [-2, 5], rtol=0.05)
    (run,) = log
    assert np.diff(run.time).max() > 0.49  # nothing acts through the gap
    for begin, end in run.pieces:
        for row in range(begin, end - 1, 40):
            acting = table["t"].between(run.time[row] - 1e-6, run.time[row] + 0.0195)
            assert run.inputs[row, 0] == pytest.approx(table["u"][acting].mean())
    held = {"u": {"columns": ["u"], "resample": "hold"}}
    last = read_log(path, {**MAPPING, "rate": 50, "inputs": held})
    assert set(np.unique(last.runs[0].inputs)) == {-1.0, 1.0}
    assert not texts(last, "averaged input")


def test_an_input_that_is_held_from_row_to_row_is_taken_as_it_is(tmp_path):
    table = fast_table(held_for=20)
    log = read_log(written(tmp_path, table), {**MAPPING, "rate": 50})
    np.testing.assert_array_equal(log.runs[0].inputs[:, 0], table["u"][::20])
    table["u"] = np.sin(3 * table["t"])
    log = read_log(written(tmp_path, table), {**MAPPING, "rate": 50})
    np.testing.assert_array_equal(log.runs[0].inputs[:, 0], table["u"][::20])
    assert not log.findings


@pytest.mark.parametrize(
    "change",
    [
        {"inputs": {"u": ["x"]}},
        {"states": {"x": ["x", "x"]}},
        {"states": {"x": ["x"], "y": ["x"]}},
        {"runs": {"a": {"x": "y1", "u": "y1"}}},
    ],
)
def test_a_column_of_the_states_is_used_once(change):
    with pytest.raises(SettingError, match="must have none of states.x again; got "):
        LogMapping.from_dict({**MAPPING, **change})


def test_an_input_may_come_twice_with_other_delays():
    inputs = {"u": ["u"], "late": {"columns": ["u"], "delay": -0.2}}
    assert len(LogMapping.from_dict({**MAPPING, "inputs": inputs}).of("inputs")) == 2


def test_an_input_that_is_a_state_in_other_units_is_noted(tmp_path):
    table = table_of()
    table["u"] = np.round(100 * table["x"] + 40, 2)
    log = read_log(written(tmp_path, table), MAPPING)
    (text,) = texts(log, "copied state")
    assert text.startswith("u is x times 100, plus a constant: predictions that are")
    table["u"] += np.cos(np.arange(300))
    assert not read_log(written(tmp_path, table), MAPPING).findings


@pytest.mark.parametrize("role", ["inputs", "context"])
def test_an_angle_that_is_no_state_and_jumps_by_a_turn_is_noted(tmp_path, role):
    table = table_of()
    table["heading"] = np.mod(10.0 * np.arange(300), 360)
    heading = {"columns": ["heading"], "kind": "angle", "unit": "deg"}
    signals = {**MAPPING.get(role, {}), "heading": heading}
    log = read_log(written(tmp_path, table), {**MAPPING, role: signals})
    (text,) = texts(log, "turns")
    assert text.startswith("heading jumps by a turn 8 times, and is no state: models")


@pytest.mark.parametrize("rate", [None, 30])
@pytest.mark.parametrize("unit", ["", "deg"])
@pytest.mark.parametrize("role", ["states", "context"])
def test_an_angle_that_nobody_declared_is_noted(tmp_path, role, unit, rate):
    table = table_of()
    table["yaw"] = np.mod(10.0 * np.arange(300) + 180, 360) - 180
    signals = {**MAPPING.get(role, {}), "heading": {"columns": ["yaw"], "unit": unit}}
    mapping = {**MAPPING, role: signals, "rate": rate}
    table["u"] = (table.index % 7).where(table.index != 50)  # a counter
    turn = "2 pi" if unit else "360"
    (text,) = texts(read_log(written(tmp_path, table), mapping), "turns")
    assert text.startswith(f"yaw jumps by a whole turn ({turn}) 8 times, and is taken")


def test_a_slower_signal_in_the_table_of_a_faster_one_is_refused(tmp_path):
    table = table_of()
    table["x"] = table["x"].where(table.index % 10 == 0)
    with pytest.raises(DataError, match="follow each .*rows, x in 30, .*state a rate"):
        read_log(written(tmp_path, table), MAPPING)
    log = read_log(written(tmp_path, table), {**MAPPING, "rate": 10})
    assert len(log) > 280


def test_rows_that_two_files_share_are_noted(tmp_path):
    table = table_of(600)
    files = [
        written(tmp_path, table[:400], "a.csv"),
        written(tmp_path, table[350:], "b.csv"),
        written(tmp_path, table.assign(x=1.1 * table["x"]), "c.csv"),
        written(tmp_path, table[100:200], "part.csv"),
        written(tmp_path, table[100:200], "same.csv"),
    ]
    log = read_log(files, MAPPING)
    assert [(f.kind, f.run, f.count) for f in log.findings] == [
        ("equal runs", "same", 100),
        ("shared rows", "b", 50),
        ("shared rows", "part", 100),
    ]
    assert log.findings[1].text.startswith(
        "50 of 250 rows are in earlier runs, such as a: held"
    )


def test_an_attitude_that_turns_on_is_noted(tmp_path):
    table = table_of()
    for half_turns in (0.9, 1.5):
        yaw = half_turns * np.pi * (1 - np.cos(np.pi * np.arange(300) / 300)) / 2
        table[["qx", "qy"]] = 0.0
        table["qz"] = np.sin(yaw / 2)
        table["qw"] = np.cos(yaw / 2)
        attitude = {"columns": ["qx", "qy", "qz", "qw"], "kind": "quaternion"}
        log = read_log(
            written(tmp_path, table), {**MAPPING, "states": {"attitude": attitude}}
        )
        noted = [one for one in log.findings if one.kind == "opposite quaternions"]
        assert len(noted) == (half_turns > 1)
        assert all(one.text.startswith("attitude turns by more than") for one in noted)
