"""Rows stand in the order of their stamps, and nothing is carried over a jump."""

import sys
import time
from pathlib import Path

import numpy as np
import pandas
import pytest

sys.path.append(str(Path(__file__).resolve().parents[2]))
from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, inspect_log, read_log
from tests.logs import strange
from tests.logs.strange import BAG_MAPPING, BEGIN, STEP, TABLE_MAPPING

TEN_DAYS = 864_000.0
ROWS = 400


def kinds(log):
    return {finding.kind: finding.count for finding in log.findings}


def texts(log):
    return " ".join(finding.text for finding in log.findings)


def set_by_ntp(stamps):
    """Of a clock that began at 5 s and was set after 50 messages."""
    return np.r_[5 + STEP * np.arange(50), stamps[50:]]


def with_a_last_stamp(stamps):
    return np.r_[stamps[:-1], 2_147_483_647.0]


def ten_days_on(stamps):
    return stamps + TEN_DAYS * (np.arange(len(stamps)) >= 200)


def ten_days_back(stamps):
    return stamps - TEN_DAYS * (np.arange(len(stamps)) >= 200)


JUMPS = [  # rows before and after, by the time that comes first
    (set_by_ntp, 50, 350),
    (with_a_last_stamp, 399, 1),
    (ten_days_on, 200, 200),
    (ten_days_back, 200, 200),
]


@pytest.mark.parametrize("rate", [None, 50])
@pytest.mark.parametrize(("change", "before", "after"), JUMPS)
def test_both_sides_of_a_jump_are_used_and_nothing_goes_over_it(
    tmp_path, change, before, after, rate
):
    table = strange.pendulum(ROWS)
    table["t"] = change(BEGIN + table["t"].to_numpy())
    table.to_csv(tmp_path / "arm.csv", index=False)
    log = read_log(tmp_path / "arm.csv", {**TABLE_MAPPING, "rate": rate})
    (run,) = log
    assert kinds(log)["jump"] == 1
    assert f"behind row {before} of {ROWS}" in texts(log)
    # A grid may leave out the last row of a piece, and a piece of a single row.
    assert abs(run.pieces[0][1] - before) <= 1
    assert abs(len(run) - run.pieces[0][1] - after) <= 1
    assert np.diff(run.time[run.begins[0] : run.pieces[0][1]]).max() < 1.5 * STEP


def test_a_bag_whose_clock_was_set_has_the_pieces_of_both_topics(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        topics[name] = topic._replace(stamps=set_by_ntp(topic.stamps))
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    (run,) = log
    assert [end - begin for begin, end in run.pieces] == [50, 350]
    np.testing.assert_allclose(
        run.states[:, 0], strange.pendulum(ROWS)["angle"], atol=1e-6
    )
    assert texts(log).count("by up to 1.7e+09 s, the first behind row 50 of 400") == 2


def test_what_one_topic_holds_alone_is_counted(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    stamps = set_by_ntp(topics["/arm"].stamps)
    topics["/arm"] = topics["/arm"]._replace(stamps=stamps)
    topics["/motor"] = topics["/motor"]._replace(stamps=None)
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    assert kinds(log) == {"jump": 1, "no time in common": 50}
    assert 349 <= len(log) <= 350


@pytest.mark.parametrize("rate", [None, 50])
@pytest.mark.parametrize("seed", [0, 1])
def test_rows_out_of_order_are_sorted_and_none_is_thrown_away(tmp_path, rate, seed):
    table = strange.pendulum(ROWS)
    order = np.random.default_rng(seed).permutation(ROWS)
    if seed:
        order = np.arange(ROWS)
        order[100:103] = [102, 100, 101]
    mapping = {**TABLE_MAPPING, "rate": rate}
    table.to_csv(tmp_path / "sorted.csv", index=False)
    table.iloc[order].to_csv(tmp_path / "mixed.csv", index=False)
    expected = read_log(tmp_path / "sorted.csv", mapping)
    log = read_log(tmp_path / "mixed.csv", mapping)
    np.testing.assert_array_equal(log.runs[0].states, expected.runs[0].states)
    assert log.runs[0].begins == (0,)
    assert list(kinds(log)) == ["rows out of order"]


def test_messages_in_any_order_are_the_bag_that_they_are(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    expected = read_log(strange.write_bag(tmp_path / "a.mcap", topics), BAG_MAPPING)
    shuffled = np.random.default_rng(0).permutation
    for order in (shuffled, lambda count: range(count - 1, -1, -1)):
        path = strange.write_bag(tmp_path / "b.mcap", topics, order=order)
        log = read_log(path, BAG_MAPPING)
        np.testing.assert_array_equal(log.runs[0].states, expected.runs[0].states)


def test_messages_that_arrive_late_are_sorted_by_their_stamps(tmp_path):
    rng = np.random.default_rng(0)
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        late = topic.log_times + rng.uniform(0, 0.05, ROWS)
        topics[name] = topic._replace(log_times=late)
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    assert (len(log), len(log.runs[0].begins)) == (ROWS, 1)
    assert list(kinds(log)) == ["rows out of order"]


def test_a_clock_that_was_set_back_is_named_with_a_way_out(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        stamps = topic.stamps - 2.0 * (np.arange(ROWS) >= 200)
        topics[name] = topic._replace(stamps=stamps)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    with pytest.raises(
        DataError, match="runs backwards in row 201 .* write 'stamp: log' to take"
    ):
        read_log(path, BAG_MAPPING)
    assert len(read_log(path, {**BAG_MAPPING, "stamp": "log"})) == ROWS


@pytest.mark.parametrize("offset", [0.0, 0.1, 0.37, 0.5])
@pytest.mark.parametrize("rows", [ROWS, ROWS * 3 // 4])
@pytest.mark.parametrize("rate", [None, 50])
def test_two_runs_at_one_time_are_never_mixed(tmp_path, offset, rows, rate):
    first = strange.pendulum(ROWS)
    second = strange.pendulum(rows)
    second["t"] += offset * STEP
    both = pandas.concat([first, second])
    both.to_csv(tmp_path / "arm.csv", index=False)
    log = read_log(tmp_path / "arm.csv", {**TABLE_MAPPING, "rate": rate})
    (run,) = log
    assert run.begins == (0, ROWS)
    np.testing.assert_allclose(run.states, both[["angle", "rate"]], atol=1e-9)
    assert kinds(log) == {"clock began anew": 1}


def test_rows_of_two_clocks_in_turn_are_refused(tmp_path):
    first = strange.pendulum(ROWS)
    second = first.assign(t=first["t"] + 0.3 * STEP)
    for rows in (20, 100):
        in_turn = [
            part[k : k + rows] for k in range(0, ROWS, rows) for part in (first, second)
        ]
        pandas.concat(in_turn).to_csv(tmp_path / "arm.csv", index=False)
        with pytest.raises(DataError, match="runs backwards in row .*the runs"):
            read_log(tmp_path / "arm.csv", TABLE_MAPPING)


@pytest.mark.parametrize("rate", [None, 50])
def test_nothing_is_carried_over_a_clock_that_was_set_back(tmp_path, rate):
    table = strange.pendulum(ROWS)
    table["t"] -= 0.2 * (np.arange(ROWS) >= 200)
    table.to_csv(tmp_path / "arm.csv", index=False)
    (run,) = read_log(tmp_path / "arm.csv", {**TABLE_MAPPING, "rate": rate})
    assert run.begins == (0, 200)


def test_few_rows_of_a_clock_that_was_set_back_are_left_out(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        stamps = topic.stamps - 0.2 * (np.arange(ROWS) >= 200)
        topics[name] = topic._replace(stamps=stamps)
    shuffled = np.random.default_rng(0).permutation
    path = strange.write_bag(tmp_path / "arm.mcap", topics, order=shuffled)
    log = read_log(path, BAG_MAPPING)
    backwards = [f.count for f in log.findings if f.kind == "stamp runs backwards"]
    assert len(backwards) == 2
    assert all(9 <= count <= 11 for count in backwards)


@pytest.mark.parametrize(("unit", "factor"), [("us", 1e6), ("ns", 1e9)])
def test_a_clock_in_messages_without_a_header_is_named(tmp_path, unit, factor):
    topics = strange.pendulum_topics(ROWS, header=False)
    for name, topic in topics.items():
        clock = np.round(factor * (5 + STEP * np.arange(ROWS)))
        columns = {**topic.columns, "timestamp": clock}
        topics[name] = topic._replace(columns=columns)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    log = read_log(path, BAG_MAPPING)
    assert kinds(log) == {"times of the log": ROWS}
    assert f"time: {{column: timestamp, unit: {unit}}} takes it" in texts(log)
    time = {"column": "timestamp", "unit": unit}
    log = read_log(path, {**BAG_MAPPING, "time": time})
    assert (log.runs[0].time[0], kinds(log)) == (5.0, {})


def test_a_simulated_clock_that_begins_at_zero_is_a_clock(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        topics[name] = topic._replace(stamps=STEP * np.arange(ROWS))
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    assert (len(log), kinds(log)) == (ROWS, {})
    np.testing.assert_allclose(log.runs[0].time, STEP * np.arange(ROWS), atol=1e-9)


@pytest.mark.parametrize("stuck", [0.0, 7.0])
def test_headers_that_nobody_stamps_count_as_none(tmp_path, stuck):
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        topics[name] = topic._replace(stamps=np.full(ROWS, stuck))
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    assert len(log) == ROWS
    assert log.runs[0].time[0] == BEGIN


def test_topics_with_and_without_a_header_have_time_in_common(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    topics["/motor"] = topics["/motor"]._replace(stamps=None)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    log = read_log(path, BAG_MAPPING)  # the headers' clock is the log's
    assert (len(log), kinds(log)) == (ROWS - 1, {})
    times = STEP * np.arange(ROWS)  # now it is not
    topics["/arm"] = topics["/arm"]._replace(stamps=times)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    log = read_log(path, BAG_MAPPING)
    assert (len(log), kinds(log)) == (ROWS, {"times of the log": 1})
    assert "-1.7e+09 s off the clock of /motor" in texts(log)
    with pytest.raises(DataError, match="stamp: header, but the messages of /motor"):
        read_log(path, {**BAG_MAPPING, "stamp": "header"})


@pytest.mark.parametrize(
    ("header", "offset", "text"),
    [
        (True, -0.4, "the stamps of /motor are 0.4 s ahead of the clock of /arm"),
        (True, 0.1, "the stamps of /motor are 0.1 s behind the clock of /arm"),
        (False, -0.4, "the stamps of /arm are 0.401 s behind the clock of /motor"),
    ],
)
def test_clocks_that_are_less_than_a_second_apart_are_a_finding(
    tmp_path, header, offset, text
):
    topics = strange.pendulum_topics(ROWS)
    arm = topics["/arm"]
    topics["/arm"] = arm._replace(stamps=arm.stamps + offset)
    if not header:
        topics["/motor"] = topics["/motor"]._replace(stamps=None)
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    (finding,) = [f for f in log.findings if f.kind == "stamps apart"]
    assert finding.text.startswith(text)


def test_topics_of_two_clocks_take_the_times_of_the_log(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    stamps = topics["/arm"].stamps - 5.0
    topics["/arm"] = topics["/arm"]._replace(stamps=stamps)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    log = read_log(path, BAG_MAPPING)
    assert (len(log), kinds(log)) == (ROWS, {"times of the log": 1})
    by_header = read_log(path, {**BAG_MAPPING, "stamp": "header"})
    assert len(by_header) == 150  # of 8 s, less the 5
    far = topics["/arm"]._replace(stamps=stamps - 1e6)
    path = strange.write_bag(tmp_path / "far.mcap", topics | {"/arm": far})
    with pytest.raises(
        DataError, match="have no time in common: write 'stamp: log' to take"
    ):
        read_log(path, {**BAG_MAPPING, "stamp": "header"})


def test_a_simulation_slower_than_the_log_keeps_its_stamps(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    for name, topic in topics.items():
        slow = BEGIN + 3 * (topic.log_times - BEGIN)
        topics[name] = topic._replace(log_times=slow, stamps=topic.log_times - BEGIN)
    motor = topics["/motor"]
    topics["/motor"] = motor._replace(
        columns={"torque": motor.columns["torque"][300:]},
        log_times=motor.log_times[300:],
        stamps=motor.stamps[300:],
    )
    log = read_log(strange.write_bag(tmp_path / "arm.mcap", topics), BAG_MAPPING)
    assert (len(log), kinds(log)) == (100, {})
    assert log.runs[0].time[0] == pytest.approx(6.0)


def test_messages_without_the_stamp_of_the_others_are_counted(tmp_path):
    topics = strange.pendulum_topics(ROWS, encoding="json")
    path = tmp_path / "arm.mcap"
    stamps = topics["/arm"].stamps.astype(object)
    stamps[100] = None
    topics["/arm"] = topics["/arm"]._replace(stamps=stamps)
    log = read_log(strange.write_bag(path, topics), BAG_MAPPING)
    assert kinds(log) == {"no stamp": 1}
    assert len(log) == ROWS


@pytest.mark.parametrize("time", [{"time": {"step": 0.1}}, {"rate": 10}])
@pytest.mark.parametrize(
    ("runs", "pieces"),
    [
        (["A"] * 100 + ["B"] * 100 + ["A"] * 100, {"A": [100, 100], "B": [100]}),
        (["A"] * 100 + [""] * 10 + ["A"] * 190, {"A": [100, 190]}),
        (["A", "B"] * 150, {"A": [150], "B": [150]}),  # which take turns
    ],
)
def test_rows_that_a_run_lacks_took_time_as_well(tmp_path, time, runs, pieces):
    phase = 0.1 * np.arange(300)
    states = np.cumsum(2 + np.sin(phase))
    table = pandas.DataFrame({"k": runs, "x": states, "u": np.cos(phase)})
    table.to_csv(tmp_path / "a.csv", index=False)
    mapping = {"states": {"x": ["x"]}, "inputs": {"u": ["u"]}, "run": "k", **time}
    log = read_log(tmp_path / "a.csv", mapping)
    assert log.time_step == pytest.approx(0.1)
    assert {
        run.name.removeprefix("a:"): [end - begin for begin, end in run.pieces]
        for run in log
    } == pieces


@pytest.mark.parametrize(
    "name",
    ["t", "time", "Time [s]", "time (us)", "TimeUS", "TIME", "Zeit [min]", "Datum"],
)
def test_a_rate_counts_no_rows_beside_a_column_of_times(tmp_path, name):
    table = strange.pendulum(ROWS).rename(columns={"t": name})
    if name == "Datum":  # no name of times, but dates
        table[name] = pandas.to_datetime(BEGIN + table[name], unit="s")
    table.to_csv(tmp_path / "arm.csv", index=False)
    signals = {key: TABLE_MAPPING[key] for key in ("states", "inputs")}
    with pytest.raises(DataError, match="is called as times are.*time: {step: 0.02}"):
        read_log(tmp_path / "arm.csv", {**signals, "rate": 50})
    with pytest.raises(DataError, match="is called as times are"):
        read_log(tmp_path / "arm.csv", signals)
    mapping = LogMapping.from_dict({**signals, "rate": 50})
    warnings = " ".join(inspect_log(tmp_path / "arm.csv", mapping).warnings)
    assert "is called as times are" in warnings


def test_the_date_of_a_file_is_no_time_of_its_rows(tmp_path):
    table = strange.pendulum(ROWS).drop(columns="t")
    table["made"] = pandas.Timestamp("2024-05-01 12:00")
    table["day"] = ["2024-05-01"] * 300 + ["2024-05-02"] * (ROWS - 300)
    table.to_parquet(tmp_path / "arm.parquet")
    signals = {key: TABLE_MAPPING[key] for key in ("states", "inputs")}
    log = read_log(tmp_path / "arm.parquet", {**signals, "rate": 50})
    assert (len(log), kinds(log)) == (ROWS, {"no times": ROWS})
    assert "400 rows are taken as 0.02 s apart, by the rate" in texts(log)


SIGNALS = {"states": {"x": ["x"]}, "inputs": {"u": ["u"]}}


@pytest.mark.parametrize(
    ("header", "mapping", "step"),
    [
        ("t,x,u\nms,m,N\n", {"time": "t", **SIGNALS}, 0.02),
        ("t,x,u\n(ms),(m),(N)\n\n", {"time": "t", **SIGNALS}, 0.02),
        ("t_ms,x,u\n", {"time": 1, **SIGNALS}, 0.02),
        ("millis,x,u\n", {"time": "millis", **SIGNALS}, 0.02),
        ("time_boot_ms,x,u\n", {"time": "time_boot_ms", **SIGNALS}, 0.02),
        ("elapsed_msec,x,u\n", {"time": "elapsed_msec", **SIGNALS}, 0.02),
        ("t_ms,x,u\n", {"time": "t", "names": ["t"], **SIGNALS}, 0.02),
        ("t [ms],x,u\n", {"time": "T", "runs": {"": {"T": "t [ms]"}}, **SIGNALS}, 0.02),
        ("time (msec),x,u\n", {"time": 1, **SIGNALS}, 0.02),
        ("Zeit [ms],x,u\n", {"time": 1, **SIGNALS}, 0.02),
        ("Zeit/ms,x,u\n", {"time": 1, **SIGNALS}, 0.02),
        ("t,x,u\nmsec,m,N\n", {"time": "t", **SIGNALS}, 0.02),
        ("Zeit,x,u\nms,\N{DEGREE SIGN}C,l/min\n", {"time": "Zeit", **SIGNALS}, 0.02),
        ("t,x,u\nns,m,N\n", {"time": "t", **SIGNALS}, 20e-9),
        ("Time [\N{MICRO SIGN}s],x,u\n", {"time": 1, **SIGNALS}, 20e-6),
        ("elapsed (microseconds),x,u\n", {"time": 1, **SIGNALS}, 20e-6),
        ("time [min],x,u\n", {"time": 1, **SIGNALS}, 1200),
        ("t,x,u\nh,m,N\n", {"time": "t", **SIGNALS}, 72_000),
        ("Time (sec.),x,u\n", {"time": 1, **SIGNALS}, 20),
        ("t [S],x,u\n", {"time": 1, **SIGNALS}, 20),
        ("t (ms since start),x,u\n", {"time": 1, **SIGNALS}, 0.02),
        ("t,x,u\n", {"time": {"column": "t", "unit": "d"}, **SIGNALS}, 1_728_000),
    ],
)
def test_the_unit_that_a_file_says_of_its_times_is_taken(
    tmp_path, header, mapping, step
):
    rows = [f"{20 * k},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text(header + "".join(rows))
    log = read_log(tmp_path / "a.csv", mapping)
    assert log.time_step == pytest.approx(step)
    assert not kinds(log).keys() - {"time step"}  # a short one, or a long one
    if isinstance(mapping["time"], str | int):
        inspection = inspect_log(tmp_path / "a.csv", time="1")
        assert inspection.streams["rate [Hz]"][0] == pytest.approx(1 / step)


@pytest.mark.parametrize("name", ["Time (UTC)", "time (left)", "t (rel)", "Time (A)"])
def test_a_word_in_brackets_is_no_unit_of_times(tmp_path, name):
    rows = [f"{0.02 * k},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text(f"{name},x,u\n" + "".join(rows))
    for column in (name, 1):
        log = read_log(tmp_path / "a.csv", {"time": column, **SIGNALS})
        assert log.time_step == pytest.approx(0.02)


@pytest.mark.parametrize("header", ["time [km/h],x,u\n", "t,x,u\nV,m,N\n"])
def test_what_is_no_unit_of_times_is_asked_for(tmp_path, header):
    rows = [f"{0.02 * k},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text(header + "".join(rows))
    with pytest.raises(DataError, match="which is no unit of times: in which is it"):
        read_log(tmp_path / "a.csv", {"time": 1, **SIGNALS})
    assert "no unit of times" in inspect_log(tmp_path / "a.csv", time="1").warnings[0]
    stated = {"time": {"column": 1, "unit": "s"}, **SIGNALS}
    assert read_log(tmp_path / "a.csv", stated).time_step == pytest.approx(0.02)


@pytest.mark.parametrize(
    "text",
    [
        *("00:01:{:05.2f}", "{:.2f} sec", "{:.4f} s", "2024-05-01 12:00:{:05.2f}"),
        *("2024_5_1_12_00_{:05.2f}", "2024/05/01 12:00:{:05.2f}"),
    ],
)
def test_times_in_texts_are_read(tmp_path, text):
    rows = [f"{text.format(0.5 * k)},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text("t,x,u\n" + "".join(rows))
    log = read_log(tmp_path / "a.csv", {"time": "t", **SIGNALS})
    assert (log.time_step, kinds(log)) == (0.5, {})
    assert inspect_log(tmp_path / "a.csv").streams["rate [Hz]"][0] == 2


def test_milliseconds_of_a_date_may_have_fewer_digits(tmp_path):
    rows = [
        f"2024_5_1_12_0_{k // 20}_{50 * (k % 20)},{k % 7},{k % 3}\n" for k in range(60)
    ]
    (tmp_path / "a.csv").write_text("t,x,u\n" + "".join(rows))
    log = read_log(tmp_path / "a.csv", {"time": "t", **SIGNALS})
    assert log.time_step == pytest.approx(0.05)
    assert kinds(log) == {}


def test_a_unit_of_time_other_than_the_mappings_is_noted(tmp_path):
    rows = [f"{20 * k},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text("t [ms],x,u\n" + "".join(rows))
    log = read_log(
        tmp_path / "a.csv", {"time": {"column": "t [ms]", "unit": "s"}, **SIGNALS}
    )
    assert "than the mapping: t [ms] in ms (taken as s)" in texts(log)


@pytest.mark.parametrize(("name", "time"), [("t", {"time": "t"}), ("timestamp", {})])
def test_whole_numbers_without_a_unit_are_noted(tmp_path, name, time):
    rows = [f"{20 * k},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text(f"{name},x,u\n" + "".join(rows))
    log = read_log(tmp_path / "a.csv", {**time, **SIGNALS})
    assert kinds(log) == {"unit of the time": 60}
    doubt = f"rows are taken as 20 s apart; of ms, state time: {{column: {name}, unit"
    assert doubt in texts(log)
    assert doubt in " ".join(inspect_log(tmp_path / "a.csv").warnings)
    stated = {"time": {"column": name, "unit": "s"}, **SIGNALS}
    assert not kinds(read_log(tmp_path / "a.csv", stated))


def test_a_column_that_is_counted_from_zero_is_missing(tmp_path):
    (tmp_path / "a.csv").write_text("k,x,u\n0,1,2\n1,2,3\n2,3,5\n")
    with pytest.raises(DataError, match="column '0' is missing"):
        read_log(tmp_path / "a.csv", {"time": 0, "rate": 10, **SIGNALS})
    with pytest.raises(DataError, match="column '0' is missing"):
        read_log(
            tmp_path / "a.csv", {"time": {"step": 1}, **SIGNALS, "states": {"x": 0}}
        )


def test_stamps_of_a_far_year_are_in_another_unit(tmp_path):
    rows = [f"{1_700_000_000_000 + 20 * k},{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text("t,x,u\n" + "".join(rows))
    with pytest.raises(DataError, match="a year after 5000 if t is in s: in which"):
        read_log(tmp_path / "a.csv", {"time": "t", **SIGNALS})


def test_a_time_step_in_a_column_has_the_unit_of_the_file(tmp_path):
    rows = [f"20,{k % 7},{k % 3}\n" for k in range(60)]
    (tmp_path / "a.csv").write_text("Ts,x,u\n[ms],[m],[N]\n" + "".join(rows))
    log = read_log(tmp_path / "a.csv", {"time": {"step": "Ts"}, **SIGNALS})
    assert log.time_step == pytest.approx(0.02)


@pytest.mark.parametrize("rate", [60, 120, 240, 400])
def test_stamps_rounded_to_ms_have_the_step_of_the_clock(tmp_path, rate):
    table = strange.pendulum(ROWS)
    table["t"] = np.round(np.arange(ROWS) / rate, 3)
    table.to_csv(tmp_path / "arm.csv", index=False)
    log = read_log(tmp_path / "arm.csv", TABLE_MAPPING)
    assert log.time_step == pytest.approx(1 / rate, rel=2e-3)


def test_rows_that_come_late_leave_the_time_step_as_it_is(tmp_path):
    table = strange.pendulum(ROWS)
    table.loc[5::20, "t"] += 0.95 * STEP
    table.to_csv(tmp_path / "arm.csv", index=False)
    log = read_log(tmp_path / "arm.csv", TABLE_MAPPING)
    assert log.time_step == pytest.approx(STEP)


def test_a_table_of_one_time_is_refused(tmp_path):
    strange.pendulum(ROWS).assign(t=1.0).to_csv(tmp_path / "arm.csv", index=False)
    with pytest.raises(DataError, match="no two rows have different stamps"):
        read_log(tmp_path / "arm.csv", TABLE_MAPPING)


def test_a_mapping_says_which_stamps_it_takes():
    states = {"angle": ["angle"]}
    assert LogMapping.from_dict({"states": states, "stamp": "log"}).stamp == "log"
    with pytest.raises(SettingError, match="stamp: must be one of '', 'header', 'log'"):
        LogMapping.from_dict({"states": states, "stamp": "both"})
    with pytest.raises(SettingError, match="stamp: has no effect where time names"):
        LogMapping.from_dict({"states": states, "stamp": "log", "time": "t"})


def test_an_inspection_reads_bags_in_any_order_and_what_is_whole(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    path = strange.write_bag(
        tmp_path / "arm.mcap", topics, order=np.random.default_rng(0).permutation
    )
    path.write_bytes(path.read_bytes()[:-1500])
    mapping = LogMapping.from_dict({**BAG_MAPPING, "keep": {"battery": [10, None]}})
    wrong = inspect_log(path, mapping)
    assert any("cannot be learned from: keep" in text for text in wrong.warnings)
    inspection = inspect_log(path)
    assert list(inspection.streams["backward stamps"]) == [0, 0]
    assert any(warning.startswith("damaged: ") for warning in inspection.warnings)


def test_thousands_of_jumps_take_no_longer_than_their_rows(tmp_path):
    rows = np.arange(30_000)
    table = strange.pendulum(3).iloc[rows % 3].assign(torque=rows % 7)
    table["t"] = STEP * rows + 1e5 * (rows // 3)
    table.to_csv(tmp_path / "arm.csv", index=False)
    mapping = {**TABLE_MAPPING, "rate": 50, "held": "use"}
    begin = time.monotonic()
    log = read_log(tmp_path / "arm.csv", mapping)
    assert time.monotonic() - begin < 5
    assert (len(log), kinds(log)) == (len(rows), {"jump": 9999})
