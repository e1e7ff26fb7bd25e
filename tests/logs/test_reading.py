"""Logs come out as they were measured: faults are named, and no gap is bridged."""

import struct
from pathlib import Path

import numpy as np
import pandas
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, inspect_log, read_log
from tests.cli.command import called
from tests.logs.tables import split_into_runs

PENDULUM = {
    "time": {"column": "t"},
    "states": {
        "angle": {"columns": ["angle"], "unit": "rad"},
        "rate": {"columns": ["rate"], "unit": "rad/s"},
    },
    "inputs": {"torque": {"columns": ["torque"], "unit": "N m"}},
}
BODY = {
    "time": "t",
    "model": "rigid_body",
    "states": {
        "position": {"columns": ["px", "py", "pz"], "unit": "m"},
        "attitude": {
            "columns": ["roll", "pitch", "yaw"],
            "kind": "euler",
            "unit": "rad",
        },
        "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s", "frame": "world"},
        "rate": {"columns": ["wx", "wy", "wz"], "unit": "rad/s", "frame": "body"},
    },
    "inputs": {"thrust": ["u"]},
}


def wrap(angle):
    """The same angles between -pi and pi."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def pendulum_table(rows=400, seed=0):
    rng = np.random.default_rng(seed)
    angle = 0.3
    rate = 0.0
    table = []
    torques = np.repeat(rng.uniform(-3, 3, rows // 5 + 1), 5)
    for k in range(rows):
        table.append((0.02 * k, angle, rate, torques[k]))
        rate += 0.02 * (torques[k] - 0.3 * rate - 5 * np.sin(angle))
        angle += 0.02 * rate
    return pandas.DataFrame(table, columns=["t", "angle", "rate", "torque"])


_NAMES = "px,py,pz,roll,pitch,yaw,vx,vy,vz,wx,wy,wz,u".split(",")  # noqa: SIM905


def body_table(rows=300):
    """A body that turns about all axes along a curve, at 100 Hz."""
    t = 0.01 * np.arange(rows)
    euler = np.column_stack(
        [0.5 * np.sin(2 * t), 0.4 * np.cos(3 * t), 0.9 * np.sin(1.5 * t)]
    )
    p = np.column_stack([np.sin(2 * t), np.cos(1.5 * t), 1 + 0.3 * np.sin(3 * t)])
    (r, q, _), (dr, dq, dy) = euler.T, np.gradient(euler, 0.01, axis=0).T
    w = [
        dr - dy * np.sin(q),
        dq * np.cos(r) + dy * np.sin(r) * np.cos(q),
        -dq * np.sin(r) + dy * np.cos(r) * np.cos(q),
    ]
    columns = np.column_stack(
        [t, p, euler, np.gradient(p, 0.01, axis=0), np.transpose(w), np.sin(9 * t)]
    )
    return pandas.DataFrame(
        columns,
        columns=[
            "t",
            "px",
            "py",
            "pz",
            "roll",
            "pitch",
            "yaw",
            "vx",
            "vy",
            "vz",
            "wx",
            "wy",
            "wz",
            "u",
        ],
    )


def written(folder, table, name="log.csv"):
    table.to_csv(folder / name, index=False)
    return folder / name


def changed(mapping, role, signal, **values):
    return {
        **mapping,
        role: {**mapping[role], signal: {**mapping[role][signal], **values}},
    }


def kinds(log):
    return {finding.kind: finding.count for finding in log.findings}


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/log.csv", "b/log.csv", "c.csv"], ["a/log", "b/log", "c"]),
        (["a/1/log.csv", "b/1/log.csv"], ["a/1/log", "b/1/log"]),
        (["a/log.csv", "a/log.txt"], ["log.csv", "log.txt"]),
    ],
)
def test_files_of_one_name_are_runs_by_their_folders(tmp_path, files, names):
    for number, name in enumerate(files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        lines = pendulum_table(seed=number).to_csv(index=False)
        (tmp_path / name).write_text(f"of this run\n{lines}")
    log = read_log([tmp_path / name for name in files], PENDULUM)
    assert [run.name for run in log] == names
    assert [finding.run for finding in log.findings] == names
    with pytest.raises(DataError, match="is given twice"):
        read_log([tmp_path / files[0], tmp_path / files[0]], PENDULUM)


def test_no_transition_or_window_goes_over_a_gap(tmp_path):
    table = pendulum_table()
    with_gaps = table.drop(index=[*range(100, 115), 200, *range(301, 303)])
    log, whole = (
        read_log(written(tmp_path, t, f"{len(t)}.csv"), PENDULUM)
        for t in (with_gaps, table)
    )
    assert [len(run.begins) for run in (*log, *whole)] == [4, 1]
    assert kinds(log) == {"gap": 3}
    steps = {
        tuple(row)
        for row in np.hstack(
            [whole.transitions().features, whole.transitions().next_states]
        ).tolist()
    }
    rows = np.hstack(
        [log.transitions().features, log.transitions().next_states]
    ).tolist()
    assert len(rows) == len(with_gaps) - 4
    assert all(tuple(row) in steps for row in rows)
    assert sum(len(episode) for episode in log.episodes()) == len(rows)
    windows = log.windows(ahead=20, past=5, stride=3)
    whole_windows = {w.tobytes() for w in whole.windows(ahead=20, past=5).states}
    assert all(w.tobytes() in whole_windows for w in windows.states)


@pytest.mark.parametrize("max_gap", [0.05, 1.0])
def test_without_a_rate_no_longer_gap_is_one_step(tmp_path, max_gap):
    table = pendulum_table().drop(index=[200])  # a step of 0.04 s
    log = read_log(written(tmp_path, table), {**PENDULUM, "max_gap": max_gap})
    assert log.runs[0].begins == (0, 200)
    assert "only a rate resamples" in log.findings[0].text
    resampled = read_log(
        written(tmp_path, table), {**PENDULUM, "max_gap": max_gap, "rate": 50}
    )
    assert resampled.runs[0].begins == (0,)
    assert len(resampled) == 400


def test_resampled_rows_do_not_depend_on_when_the_clock_began(tmp_path):
    table = pendulum_table(100)
    first, later = (
        read_log(
            written(tmp_path, table.assign(t=table["t"] + begin), f"{begin}.csv"),
            {**PENDULUM, "rate": 40},
        )
        for begin in (0, 4096)
    )
    assert len(first) == len(later) == 80  # of 1.98 s, with both ends
    assert kinds(first) == kinds(later) == {}
    np.testing.assert_allclose(
        later.runs[0].states, first.runs[0].states, rtol=0, atol=1e-9
    )


def test_every_kind_of_file_gives_the_same_log(tmp_path):
    table = pendulum_table()
    log = read_log(written(tmp_path, table), PENDULUM)
    table.to_csv(tmp_path / "a.csv.gz", index=False, sep=";")
    table.to_parquet(tmp_path / "a.parquet")
    np.savez(tmp_path / "a.npz", **{name: table[name].to_numpy() for name in table})
    for name in ("a.csv.gz", "a.parquet", "a.npz"):
        other = read_log(tmp_path / name, PENDULUM)
        np.testing.assert_allclose(
            other.runs[0].states, log.runs[0].states, rtol=0, atol=1e-12
        )
        np.testing.assert_array_equal(other.runs[0].inputs, log.runs[0].inputs)


def test_runs_are_told_apart_by_file_or_by_column(tmp_path):
    one = pendulum_table(100)
    other = pendulum_table(120, seed=1)
    files = [written(tmp_path, one, "one.csv"), written(tmp_path, other, "other.csv")]
    log = read_log(files, PENDULUM)
    train, held_out = log.split(["other"])
    assert ([run.name for run in train], [run.name for run in held_out]) == (
        ["one"],
        ["other"],
    )
    both = pandas.concat([one.assign(flight="a"), other.assign(flight="b")])
    log = read_log(written(tmp_path, both), {**PENDULUM, "run": "flight"})
    assert [len(run) for run in log] == [100, 120]
    with pytest.raises(SettingError, match="no such run 'c'"):
        log.split(["c"])
    both["flight"] = both["flight"].where(both["t"] > 0.3)
    log = read_log(written(tmp_path, both), {**PENDULUM, "run": "flight"})
    (finding,) = [one for one in log.findings if one.kind == "no run"]
    assert (finding.run, finding.count) == ("log", 32)
    assert [len(run) for run in log] == [84, 104]
    nameless = written(tmp_path, both.assign(flight=" "))
    with pytest.raises(DataError, match="column 'flight' names no run in any row"):
        read_log(nameless, {**PENDULUM, "run": "flight"})


def test_a_number_and_its_text_name_the_same_run():
    table = pandas.DataFrame({"k": [1, 1, "1", 2]})  # such as a file read in parts
    mapping = LogMapping.from_dict({**PENDULUM, "run": "k"})
    runs = split_into_runs(Path("a.csv"), {"": table}, mapping, findings=[])
    assert [(run, len(tables[""])) for run, tables in runs] == [("1", 3), ("2", 1)]


@pytest.mark.parametrize("unit", ["m-", "m/s-", "m^-"])
def test_a_unit_with_a_loose_sign_is_a_mistake_of_the_mapping(unit):
    states = {"angle": {"columns": ["angle"], "unit": unit}}
    with pytest.raises(SettingError, match="is an unknown unit"):
        LogMapping.from_dict({**PENDULUM, "states": states})


def test_step_tests_and_decays_are_logs(tmp_path):
    """Inputs stay within each run, and the states move all the same."""
    t = 0.1 * np.arange(100)
    mapping = {
        "time": "t",
        "rest": "use",
        "states": {"x": ["x"]},
        "inputs": {"u": ["u"]},
    }
    files = []
    for u in (1.0, 2.0, 3.0):
        table = pandas.DataFrame({"t": t, "x": u * (1 - np.exp(-t / 2)), "u": u})
        files.append(written(tmp_path, table, f"step{u:g}.csv"))
    assert not read_log(files, mapping).findings
    log = read_log(files[0], mapping)
    assert [one.kind for one in log.findings] == ["constant inputs"]
    still = written(tmp_path, table.assign(x=1.0), "still.csv")
    with pytest.raises(DataError, match="the system is at rest"):
        read_log(still, mapping)


def test_findings_stay_with_the_rows_that_they_are_of(tmp_path):
    tables = [pendulum_table(100, seed) for seed in range(2)]
    both = pandas.concat(
        [table[table["t"] != 1.0].assign(flight=f) for f, table in enumerate(tables)]
    )
    both.iloc[0, both.columns.get_loc("flight")] = np.nan
    log = read_log(written(tmp_path, both), {**PENDULUM, "run": "flight"})
    runs = [(one.kind, one.run) for one in log.findings]
    assert ("gap", "log:1.0") in runs
    train, _ = log.split(["log:1.0"])
    kept = [(one.kind, one.run) for one in train.findings]
    assert kept == [pair for pair in runs if pair[1] != "log:1.0"]
    assert {"log", "log:0.0"} == {run for _, run in kept}
    for part in log.split_by_time(0.8):
        assert part.findings == log.findings


def test_repeated_and_backward_stamps_are_counted(tmp_path):
    table = pendulum_table()
    table.loc[50, "t"] = table.loc[49, "t"]
    table.loc[[100, 101], "t"] -= 0.5
    log = read_log(written(tmp_path, table), PENDULUM)
    counts = kinds(log)
    assert (counts["repeated stamp"], counts["stamp runs backwards"], len(log)) == (
        1,
        2,
        397,
    )
    set_back = table.assign(t=table["t"] - 2.0 * (table.index >= 200))
    with pytest.raises(DataError, match="time runs backwards in row 101 .* a file"):
        read_log(written(tmp_path, set_back), PENDULUM)
    wrapped = table.assign(t=table["t"] % 2.0)
    log = read_log(written(tmp_path, wrapped), PENDULUM)
    assert kinds(log)["clock began anew"] == 3
    assert kinds(log)["stamp runs backwards"] == 2


def test_missing_values_are_boundaries(tmp_path):
    table = pendulum_table()
    table.loc[30:60, "rate"] = np.nan
    log = read_log(written(tmp_path, table), PENDULUM)
    assert len(log) == 369
    assert log.runs[0].begins == (0, 30)
    assert kinds(log)["missing value"] == 31


def test_resampling_interpolates_states_and_holds_inputs(tmp_path):
    table = pendulum_table(4000)
    rng = np.random.default_rng(0)
    t = table["t"] + rng.uniform(-0.004, 0.004, len(table))
    jittered = pandas.DataFrame(
        {"t": t, "angle": np.sin(t), "rate": np.cos(t), "torque": np.floor(t)}
    )
    jittered = jittered.drop(index=range(1000, 1030))
    log = read_log(
        written(tmp_path, jittered), {**PENDULUM, "rate": 50, "max_gap": 0.05}
    )
    (run,) = log
    np.testing.assert_allclose(
        run.states, np.column_stack([np.sin(run.time), np.cos(run.time)]), atol=1e-4
    )
    assert set(run.inputs[:, 0]) <= set(jittered["torque"])
    assert len(run.begins) == 2
    assert not ((run.time > 20.01) & (run.time < 20.58)).any()


def test_an_angle_that_wraps_is_interpolated_the_short_way_round(tmp_path):
    t = 0.02 * np.arange(500) + 0.007
    angle = np.mod(3.0 * t + np.pi, 2 * np.pi) - np.pi
    table = pandas.DataFrame({"t": t, "angle": angle, "rate": 3.0, "torque": t})
    angles = {"columns": ["angle"], "unit": "rad", "kind": "angle"}
    states = {**PENDULUM["states"], "angle": angles}
    mapping = {**PENDULUM, "states": states, "rate": 100, "held": "use", "rest": "use"}
    (run,) = read_log(written(tmp_path, table), mapping)
    away = wrap(run.states[:, 0] - 3.0 * run.time)
    assert len(run.time) > 900
    assert np.abs(away - away[0]).max() < 1e-9


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_the_heading_of_a_quaternion_is_an_angle(tmp_path, order):
    table = pendulum_table().assign(x=lambda table: 0.5 * table.t, y=0.0, v=0.5)
    yaw = 2.0 * table.t  # turns twice
    tilt = np.full(len(table), 0.1)
    turns = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, -tilt]))
    signs = np.where(np.arange(len(table)) % 3, 1, -1)  # of the same attitude
    table[list("abcd")] = signs[:, None] * np.roll(
        turns.as_quat(), 1 if order == "wxyz" else 0, axis=1
    )
    heading = {"columns": [*"abcd"], "kind": "heading", "order": order}
    mapping = {
        "time": "t",
        "model": "bicycle",
        "held": "use",
        "states": {"position": ["x", "y"], "heading": heading, "speed": ["v"]},
        "inputs": {"steering": ["torque"], "drive": ["rate"]},
    }
    for rate, rows in ((None, 400), (40, 320)):
        log = read_log(written(tmp_path, table), {**mapping, "rate": rate})
        assert (log.space.angles, len(log)) == ((2,), rows)
        assert log.mapping.column_names("states")[2] == "heading"
        run = log.runs[0]
        np.testing.assert_allclose(
            wrap(run.states[:, 2] - 2 * (run.time - run.time[0])), 0, atol=1e-9
        )
    heading["delay"] = [0.1, 0.1, 0.2, 0.1]
    with pytest.raises(SettingError, match="one number for an attitude or a heading"):
        LogMapping.from_dict(mapping)


def test_a_repeated_sample_of_a_moving_system_is_left_out(tmp_path):
    table = body_table()
    table.loc[[100, 101, 102], ["px", "py", "pz"]] = table.loc[
        99, ["px", "py", "pz"]
    ].to_numpy(dtype=float)
    log = read_log(written(tmp_path, table), BODY)
    assert kinds(log) == {"held value": 3}
    assert len(log.runs[0].begins) == 2
    table = body_table().assign(
        **{
            c: body_table()[c].iloc[np.arange(300) // 5 * 5].to_numpy()
            for c in ("px", "py", "pz")
        }
    )
    with pytest.raises(DataError, match=r"position changes in \d+ of 300 rows only"):
        read_log(written(tmp_path, table), BODY)


def test_repeated_values_that_cut_a_log_are_named_with_a_way_out(tmp_path):
    table = body_table()
    position = table[["px", "py", "pz"]].round(2)
    position[1::10] = position[::10].to_numpy()  # of a coarse sensor
    table[["px", "py", "pz"]] = position
    written(tmp_path, table)
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(BODY, sort_keys=False))
    done = called("learn", "log.yaml", "log.csv", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.endswith("keep values that repeat (held: use)\n")


def test_arrays_of_dates_of_bytes_and_side_by_side_are_read(tmp_path):
    table = pendulum_table()
    steps = (1000 * table["t"]).round().astype("timedelta64[ms]").to_numpy()
    np.savez(
        tmp_path / "log.npz",
        t=np.datetime64("2024-05-01") + steps,
        run=np.repeat([b"a", b"b"], 200),
        x=table[["angle", "rate"]].to_numpy().T,
        torque=table["torque"],
        gains=np.ones((50, 2)),
    )
    states = {"angle": ["x[0]"], "rate": ["x[1]"]}
    mapping = {**PENDULUM, "states": states, "run": "run"}
    log = read_log(tmp_path / "log.npz", mapping)
    assert [run.name for run in log] == ["log:a", "log:b"]
    assert log.time_step == pytest.approx(0.02)
    states = np.concatenate([run.states for run in log])
    np.testing.assert_array_equal(states, table[["angle", "rate"]])


@pytest.mark.parametrize("rows", [10, 100])
def test_a_run_in_which_a_signal_never_changes_is_left_out(tmp_path, rows):
    still = body_table(rows)
    still[["px", "py", "pz"]] = 0.5
    moving = written(tmp_path, body_table(), "flight.csv")
    idle = written(tmp_path, still, "idle.csv")
    log = read_log([moving, idle], BODY)
    assert [run.name for run in log] == ["flight"]
    (finding,) = log.findings
    assert (finding.run, finding.count) == ("idle", rows)
    assert finding.text.startswith("is left out: position never changes: its sensor")
    with pytest.raises(DataError, match="run idle is left out: position never changes"):
        read_log(idle, BODY)


def test_signals_that_repeat_in_turn_have_a_lower_rate(tmp_path):
    table = body_table()
    at_half_the_rate = np.arange(300) // 2 * 2
    in_turn = np.maximum(at_half_the_rate - 1 + 2 * (np.arange(300) % 2), 0)
    for columns, rows in (
        (["px", "py", "pz"], at_half_the_rate),
        (["wx", "wy", "wz"], in_turn),
    ):
        table[columns] = body_table()[columns].to_numpy()[rows]
        with pytest.raises(DataError, match="position changes in 150 of 300 rows only"):
            read_log(written(tmp_path, table), BODY)


@pytest.mark.parametrize("kind", ["ms", "us", "ns", "zone", "duration"])
def test_dates_are_times_whatever_their_resolution(tmp_path, kind):
    table = pendulum_table()
    durations = pandas.to_timedelta(table["t"], unit="s")
    dates = pandas.Timestamp("2024-03-01") + durations
    table["t"] = {
        "duration": durations.astype("timedelta64[ms]"),
        "zone": dates.dt.tz_localize("Europe/Berlin"),
    }.get(kind, dates)
    if kind in ("ms", "us", "ns"):
        table["t"] = dates.astype(f"datetime64[{kind}]")
    table.to_parquet(tmp_path / "log.parquet")
    log = read_log(tmp_path / "log.parquet", PENDULUM)
    assert log.time_step == pytest.approx(0.02, abs=1e-6)
    assert (len(log), kinds(log)) == (400, {})
    inspection = inspect_log(tmp_path / "log.parquet", time="t")
    assert inspection.streams.loc[0, "rate [Hz]"] == pytest.approx(50)


def test_an_index_without_a_name_is_a_column(tmp_path):
    table = pendulum_table().drop(columns="t")
    table.index = pandas.date_range("2024-03-01", periods=len(table), freq="20ms")
    table.to_parquet(tmp_path / "log.parquet")
    mapping = {**PENDULUM, "time": "index"}
    assert read_log(tmp_path / "log.parquet", mapping).time_step == pytest.approx(0.02)
    del mapping["time"]
    with pytest.raises(DataError, match="column 'index' is called as times are"):
        read_log(tmp_path / "log.parquet", {**mapping, "rate": 10})
    inspection = inspect_log(tmp_path / "log.parquet")
    assert inspection.streams.loc[0, "rate [Hz]"] == pytest.approx(50)
    # Unless another is called so.
    table["index"] = 0.02 * np.arange(len(table))
    table.to_parquet(tmp_path / "log.parquet")
    mapping["time"] = "index"
    assert read_log(tmp_path / "log.parquet", mapping).time_step == pytest.approx(0.02)


def test_a_unit_of_times_is_of_the_column_timestamp(tmp_path):
    table = pendulum_table().rename(columns={"t": "timestamp"})
    table["timestamp"] *= 1000
    log = read_log(written(tmp_path, table), {**PENDULUM, "time": {"unit": "ms"}})
    assert log.time_step == pytest.approx(0.02)
    inspection = inspect_log(tmp_path / "log.csv", log.mapping)
    assert inspection.streams.loc[0, "rate [Hz]"] == pytest.approx(50)


def test_angles_may_count_turns(tmp_path):
    table = pendulum_table()
    table["angle"] = np.linspace(0, 60, 400)
    angle = {"columns": ["angle"], "kind": "angle", "unit": "rad"}
    mapping = changed(PENDULUM, "states", "angle", **angle)
    log = read_log(written(tmp_path, table), mapping)
    np.testing.assert_allclose(log.runs[0].states[:, 0], table["angle"])
    assert "does it count turns?" in log.findings[0].text
    paused = table.drop(index=[*range(100, 140), *range(200, 240)])
    log = read_log(written(tmp_path, paused), mapping)
    np.testing.assert_allclose(log.runs[0].states[:, 0], paused["angle"])
    for turns in (6, 7):
        degrees = np.rad2deg(np.mod(turns * table["angle"] / 20, 2 * np.pi))
        with pytest.raises(DataError, match="are these degrees"):
            read_log(written(tmp_path, table.assign(angle=degrees)), mapping)
    counted = table.assign(angle=np.mod(4 * table["angle"], 16 * np.pi))
    log = read_log(written(tmp_path, counted), mapping)  # of eight turns
    assert "does it count turns?" in log.findings[0].text
    table["angle"] = np.rad2deg(wrap(table["angle"].to_numpy()))
    with pytest.raises(DataError, match="are these degrees"):
        read_log(written(tmp_path, table), mapping)


@pytest.mark.parametrize("step", [0.01, 1.0])
def test_slow_and_steady_motion_is_not_rest(tmp_path, step):
    rows = 2000
    t = step * np.arange(rows)
    # A plant of a time constant of 1000 steps is driven by steps of 500, and a car goes
    # on steadily.
    drive = np.repeat([1.0, -0.5, 0.7, -1.0], rows // 4)
    slow = np.zeros(rows)
    for k in range(1, rows):
        slow[k] = slow[k - 1] + (drive[k - 1] - slow[k - 1]) / 1000
    way = 20 * t
    table = pandas.DataFrame({"t": t, "slow": slow, "way": way, "drive": drive})
    for state in ("slow", "way"):
        mapping = {"time": "t", "states": {"x": [state]}, "inputs": {"u": ["drive"]}}
        assert len(read_log(written(tmp_path, table), mapping)) == rows
    with_holes = table.assign(slow=np.where(np.arange(rows) % 40, slow + 9, np.nan))
    time = {"column": "t", "unit": "s"}
    mapping = {"time": time, "states": {"x": ["slow"]}, "inputs": {"u": ["drive"]}}
    log = read_log(written(tmp_path, with_holes), mapping)
    assert kinds(log) == {"empty sample": 50, "missing value": 50}
    standing = pandas.DataFrame(
        {
            "t": step * np.arange(2 * rows),
            "slow": np.r_[np.zeros(rows), slow],
            "drive": np.r_[np.zeros(rows), drive],
        }
    )
    log = read_log(written(tmp_path, standing), mapping)
    assert abs(kinds(log)["at rest"] - rows) < 60


def test_parts_at_rest_are_left_out_unless_asked_for(tmp_path):
    table = pendulum_table(600)
    standing = pandas.DataFrame(
        {"t": 0.02 * np.arange(211), "angle": 0.3, "rate": 0.0, "torque": 0.0}
    )
    both = pandas.concat([standing, table.assign(t=table["t"] + 4.22)])
    log = read_log(written(tmp_path, both), PENDULUM)
    assert 195 <= kinds(log)["at rest"] <= 211
    assert len(read_log(written(tmp_path, both), {**PENDULUM, "rest": "use"})) == 811
    with pytest.raises(DataError, match="211 of 211 rows where nothing moves"):
        read_log(written(tmp_path, standing), PENDULUM)


def settled(drive, rows_of_time_constant, resolution):
    """Returns a first-order response to a drive, in steps of a resolution."""
    state = np.zeros(len(drive))
    for k in range(1, len(drive)):
        state[k] = state[k - 1] + (drive[k - 1] - state[k - 1]) / rows_of_time_constant
    return resolution * np.round(state / resolution)


def test_what_settles_after_steps_of_an_input_is_no_rest(tmp_path):
    rng = np.random.default_rng(0)
    levels = rng.uniform(-1, 1, 8)
    # Time step [s], rows of a level, of the time constant, resolution, rows at rest.
    cases = (
        (1.0, 200, 40, 0.02, 850),  # a heater, whose sensor repeats its values
        (0.1, 50, 5, 1e-6, 0),  # a motor
        (0.01, 300, 20, 1e-6, 2000),  # a fast one
    )
    mapping = {"time": "t", "states": {"x": ["x"]}, "inputs": {"u": ["u"]}}
    for step, rows, rows_of_time_constant, resolution, rests in cases:
        drive = np.repeat(levels, rows)
        state = settled(drive, rows_of_time_constant, resolution)
        columns = {"t": step * np.arange(len(drive)), "x": state, "u": drive}
        log = read_log(written(tmp_path, pandas.DataFrame(columns)), mapping)
        assert len(log) == len(drive)
        assert log.longest_piece == len(drive)
        assert kinds(log).get("settled", 0) == pytest.approx(rests, abs=100)
    # A signal of several columns repeats itself when it has settled.
    columns["y"] = -columns["x"]
    pair = {**mapping, "states": {"levels": ["x", "y"]}}
    log = read_log(written(tmp_path, pandas.DataFrame(columns)), pair)
    assert log.longest_piece == len(drive)
    # What waits is at rest for every input that moves nothing.
    waits = np.repeat([True, False, True, False, True], 300)
    steering = np.repeat([0.0, 0.2, 0.4, -0.1, -0.3], 300)
    throttle = np.where(waits, 0.0, 1 + 0.1 * rng.standard_normal(1500))
    speed = settled(throttle, 20, 1e-6)
    table = pandas.DataFrame(
        {"t": 0.01 * np.arange(1500), "v": speed, "s": steering, "a": throttle}
    )
    mapping = {"time": "t", "states": {"v": ["v"]}, "inputs": {"u": ["s", "a"]}}
    assert 600 < kinds(read_log(written(tmp_path, table), mapping))["at rest"] <= 900


def test_euler_angles_make_quaternions_without_jumps(tmp_path):
    table = body_table()
    yaw = np.linspace(2, 12, 300)
    table["yaw"] = wrap(yaw)
    attitude = BODY["states"]["attitude"]
    euler = {"time": "t", "states": {"attitude": attitude}, "inputs": {"u": ["u"]}}
    (run,) = read_log(written(tmp_path, table), euler)
    assert np.abs(np.diff(run.states, axis=0)).max() < 0.1
    assert run.states[0, 3] >= 0
    q = Rotation.from_euler("ZYX", table[["yaw", "pitch", "roll"]].to_numpy()).as_quat()
    table[["qx", "qy", "qz", "qw"]] = q
    columns = {"columns": ["qx", "qy", "qz", "qw"], "kind": "quaternion"}
    (other,) = read_log(
        written(tmp_path, table), {**euler, "states": {"attitude": columns}}
    )
    np.testing.assert_allclose(other.states, run.states, atol=1e-12)


def test_a_quaternion_whose_sign_flips_is_the_same_attitude(tmp_path):
    table = body_table()
    q = Rotation.from_euler("ZYX", table[["yaw", "pitch", "roll"]].to_numpy()).as_quat()
    q[120:180] *= -1
    table[["qw", "qx", "qy", "qz"]] = q[:, [3, 0, 1, 2]]
    quaternion = {
        "columns": ["qw", "qx", "qy", "qz"],
        "kind": "quaternion",
        "order": "wxyz",
    }
    log = read_log(
        written(tmp_path, table),
        {**BODY, "states": {**BODY["states"], "attitude": quaternion}},
    )
    expected = read_log(written(tmp_path, table), BODY)
    assert kinds(log) == {"quaternion flips its sign": 2}
    np.testing.assert_allclose(
        log.space.difference(log.runs[0].states, expected.runs[0].states), 0, atol=1e-12
    )
    assert np.abs(np.diff(log.runs[0].states[:, 3:7], axis=0)).max() < 0.1


def test_one_wrong_attitude_is_left_out_and_many_are_refused(tmp_path):
    table = body_table()
    turns = Rotation.from_euler("ZYX", table[["yaw", "pitch", "roll"]])
    table[["qx", "qy", "qz", "qw"]] = turns.as_quat()
    mapping = changed(
        BODY, "states", "attitude", columns=["qx", "qy", "qz", "qw"], kind="quaternion"
    )
    table.loc[100:101, ["qx", "qy", "qz", "qw"]] *= 0.9
    log = read_log(written(tmp_path, table), mapping)
    assert kinds(log) == {"norm": 2, "missing value": 2}
    assert (len(log), log.runs[0].begins) == (298, (0, 100))
    table.loc[100:130, ["qx", "qy", "qz", "qw"]] *= 0.9
    with pytest.raises(DataError, match="row 101 has norm 0.81; expected unit quat"):
        read_log(written(tmp_path, table), mapping)


@pytest.mark.parametrize(
    ("spoil", "mapping", "expected"),
    [
        (
            lambda t: t.assign(vx=1e3 * t.vx, vy=1e3 * t.vy, vz=1e3 * t.vz),
            BODY,
            "velocity is 1e.03 times the derivative",
        ),
        (
            lambda t: np.degrees(t[["roll", "pitch", "yaw"]]),
            BODY,
            r"reaches .* rad: are these degrees",
        ),
        (
            lambda t: t,
            changed(BODY, "states", "attitude", unit="deg"),
            "rate is 5.* times .*is its unit right.*degrees for radians",
        ),
        (
            lambda t: t,
            changed(BODY, "states", "rate", frame="world"),
            "in body axes .*, not in world axes",
        ),
        (
            lambda t: t.assign(px=2 * t.px, qx=t.px),
            changed(BODY, "states", "position", unit="mm"),
            "velocity is .* times",
        ),
        (lambda t: t.drop(columns="wy"), BODY, "column 'wy' is missing"),
        (
            lambda t: t.assign(wy=["off", *t.wy[1:]]),
            BODY,
            "row 1, column 'wy' is 'off'",
        ),
    ],
)
def test_what_contradicts_the_mapping_is_named(tmp_path, spoil, mapping, expected):
    table = body_table()
    spoiled = (
        table.assign(**dict(spoil(table).items()))
        if len(spoil(table).columns) == 3
        else spoil(table)
    )
    with pytest.raises(DataError, match=expected):
        read_log(written(tmp_path, spoiled), mapping)


def test_files_that_cannot_be_read_are_named(tmp_path):
    np.savetxt(tmp_path / "bare.csv", pendulum_table().to_numpy(), delimiter=",")
    with pytest.raises(DataError, match="column 't' is missing; it has 1, 2, 3, 4"):
        read_log(tmp_path / "bare.csv", PENDULUM)
    (tmp_path / "a.parquet").write_bytes(b"nothing")
    with pytest.raises(DataError, match="cannot be read"):
        read_log(tmp_path / "a.parquet", PENDULUM)
    with pytest.raises(DataError, match="no such file"):
        read_log(tmp_path / "b.csv", PENDULUM)
    with pytest.raises(SettingError, match=r"states.angle.colums: no such key"):
        read_log(
            tmp_path / "b.csv", {**PENDULUM, "states": {"angle": {"colums": ["angle"]}}}
        )


def bag(path, rows=200):
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        pose = writer.register_msgdef("my/Pose", "float64 angle\nfloat64[2] rate")
        torque = writer.register_msgdef("my/Torque", "float32 torque")
        for k in range(rows):
            t = 10_000_000_000 + 20_000_000 * k
            message = {"angle": np.sin(0.02 * k), "rate": [np.cos(0.02 * k), 0.0]}
            writer.write_message("/pose", pose, message, t, t)
            if k % 2:
                writer.write_message(
                    "/torque",
                    torque,
                    {"torque": float(k % 7)},
                    t + 3_000_000,
                    t + 3_000_000,
                )
        writer.finish()


BAG = {
    "rate": 50,
    "max_gap": 0.1,
    "states": {
        "angle": {"topic": "/pose", "columns": ["angle"], "unit": "rad"},
        "rate": {"topic": "/pose", "columns": ["rate[0]"], "unit": "rad/s"},
    },
    "inputs": {"torque": {"topic": "/torque", "columns": ["torque"]}},
}


def test_a_bag_of_several_topics_comes_to_one_grid(tmp_path):
    bag(tmp_path / "bag.mcap")
    (run,) = read_log(tmp_path / "bag.mcap", BAG)
    seconds = run.time - 10
    np.testing.assert_allclose(run.states[:, 0], np.sin(seconds), atol=1e-4)
    np.testing.assert_array_equal(
        run.inputs[:, 0], (np.floor((seconds - 0.023) / 0.04 + 1e-4) * 2 + 1) % 7
    )


def test_a_range_of_a_column_in_no_topic_is_refused(tmp_path):
    bag(tmp_path / "bag.mcap")
    with pytest.raises(SettingError, match=r"^keep.height: no topic .*/pose, /torque$"):
        read_log(tmp_path / "bag.mcap", {**BAG, "keep": {"height": [0, None]}})
    log = read_log(tmp_path / "bag.mcap", {**BAG, "keep": {"torque": [-99, 99]}})
    assert "outside of keep" not in kinds(log)


def test_a_column_of_runs_needs_a_file_without_topics(tmp_path):
    bag(tmp_path / "bag.mcap")
    with pytest.raises(DataError, match=r"bag.mcap: has topics, and is one run; run: "):
        read_log(tmp_path / "bag.mcap", {**BAG, "run": "flight"})


def test_a_bag_without_the_topic_or_without_its_end_is_named(tmp_path):
    bag(tmp_path / "bag.mcap")
    with pytest.raises(DataError, match="topic '/force' is missing; it has"):
        read_log(
            tmp_path / "bag.mcap", changed(BAG, "inputs", "torque", topic="/force")
        )
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "bag.mcap").read_bytes()[:-3000])
    with pytest.raises(DataError, match=r"cut.mcap.*cannot be read to its end"):
        read_log(tmp_path / "cut.mcap", BAG)


def ulog(path, rows=100):
    def message(kind, body):
        return struct.pack("<Hc", len(body), kind) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40))
    data += message(
        b"F", b"arm:uint64_t timestamp;float angle;float rate;float torque;"
    )
    data += message(b"A", struct.pack("<BH", 0, 0) + b"arm")
    for k in range(rows):
        row = (np.sin(k / 10), np.cos(k / 10), k % 5)
        data += message(b"D", struct.pack("<HQfff", 0, 1_000_000 + 10_000 * k, *row))
    path.write_bytes(data)


def test_a_px4_log_is_read(tmp_path):
    ulog(tmp_path / "flight.ulg")
    topics = {
        role: {k: {**v, "topic": "arm"} for k, v in PENDULUM[role].items()}
        for role in ("states", "inputs")
    }
    (run,) = read_log(tmp_path / "flight.ulg", topics)
    assert len(run) == 100
    np.testing.assert_allclose(np.diff(run.time), 0.01, rtol=1e-6)
    np.testing.assert_allclose(run.states[:, 0], np.sin(np.arange(100) / 10), atol=1e-6)


def test_state_differences_are_inverse_to_displacements():
    states = {
        "p": {"columns": ["px", "py"], "unit": "m"},
        "a": {"columns": ["a"], "unit": "rad", "kind": "angle"},
        "q": {"columns": ["qx", "qy", "qz", "qw"], "kind": "quaternion"},
    }
    space = LogMapping.from_dict({**PENDULUM, "states": states}).space
    rng = np.random.default_rng(0)
    error = rng.uniform(-1.5, 1.5, (50, space.error_dim))
    state = np.hstack(
        [
            rng.normal(size=(50, 2)),
            rng.uniform(-3, 3, (50, 1)),
            Rotation.from_rotvec(rng.normal(size=(50, 3))).as_quat(),
        ]
    )
    displaced = space.displace(state, error)
    np.testing.assert_allclose(space.difference(displaced, state), error, atol=1e-12)
    displaced[:, 3:] *= -1
    np.testing.assert_allclose(space.difference(displaced, state), error, atol=1e-12)
    np.testing.assert_allclose(
        space.distances(error)[:, 2], np.linalg.norm(error[:, 3:], axis=1)
    )
    upright = np.array([0.0, 0, 0, 0, 0, 0, 1])
    turned = space.displace(upright, np.array([0, 0, 0, 0, 0, np.pi / 2]))
    x_axis = Rotation.from_quat(turned[3:]).apply([1.0, 0, 0])
    np.testing.assert_allclose(x_axis, [0, 1, 0], atol=1e-12)
