"""Numbers that no sensor measured are found, and those that one did are left alone."""

import numpy as np
import pandas
import pytest

from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, read_log

MAPPING = {
    "time": "t",
    "states": {"angle": ["angle"], "rate": ["rate"]},
    "inputs": {"torque": ["torque"]},
    "context": {"battery": ["battery"]},
}


def swing(rows=1000):
    """A pendulum that swings for 10 s."""
    t = 0.01 * np.arange(rows)
    return pandas.DataFrame(
        {
            "t": t,
            "angle": 0.8 * np.sin(3 * t) + 0.3 * np.sin(7 * t) + 0.4,
            "rate": 2.4 * np.cos(3 * t) + 2.1 * np.cos(7 * t),
            "torque": np.sin(11 * t),
            "battery": 4 - 0.01 * t,
        }
    )


def read(folder, table, **changes):
    table.to_csv(folder / "log.csv", index=False)
    return read_log(folder / "log.csv", {**MAPPING, **changes})


def findings(log):
    return {finding.kind: finding.text for finding in log.findings}


@pytest.mark.parametrize("value", [-9999, 1e30, -1e30, 32767, 65535, 3.4e38, 999999])
@pytest.mark.parametrize("column", ["angle", "torque", "battery"])
def test_a_sentinel_is_no_measurement(tmp_path, value, column):
    table = swing()
    table.loc[[100, 101, 500], column] = value
    log = read(tmp_path, table)
    assert f"3 rows of {column} hold" in findings(log)["sentinel"]
    assert len(log) == 997
    assert np.abs(log.runs[0].states).max() < 5


def test_a_sentinel_does_not_leak_by_resampling(tmp_path):
    table = swing()
    table.loc[500, "angle"] = -9999
    log = read(tmp_path, table, rate=130)
    assert np.abs(log.runs[0].states[:, 0]).max() < 2


@pytest.mark.parametrize(
    "values",
    [
        np.linspace(0, 65535, 1000),  # an input over its whole range
        np.repeat([0.0, 999.0], 500),  # on and off, in percent of ten
        np.linspace(-12000, -8000, 1001).round(),  # a sensor that passes -9999
        np.full(1000, 65535.0),
        np.zeros(1000),
        np.where(np.arange(1000) < 200, np.nan, 65535.0),
    ],
)
def test_a_value_that_only_looks_like_a_sentinel_stays(values, tmp_path):
    log = read(tmp_path, swing(len(values)).assign(battery=values))
    assert len(log) == np.isfinite(values).sum()
    assert "sentinel" not in findings(log)


@pytest.mark.parametrize("value", [-9999.0, 1e30])
def test_a_column_of_nothing_but_sentinels_is_missing(value, tmp_path):
    with pytest.raises(DataError, match="no row has a value .* battery in 0;"):
        read(tmp_path, swing(100).assign(battery=value))


@pytest.mark.parametrize("before", [1, 60])
def test_a_simulation_that_begins_at_zero_keeps_its_start(tmp_path, before):
    t = 0.01 * np.maximum(np.arange(400) - (before - 1), 0)  # from the step on
    states = {"angle": 1 - np.exp(-t / 0.3), "rate": 1 - np.exp(-t / 0.02)}
    table = swing(400).assign(**states)
    log = read(tmp_path, table)
    assert "all zero" not in findings(log)
    assert (log.runs[0].states[0] == 0).all()
    silent = swing()
    silent.loc[:29, ["angle", "rate"]] = 0.0
    assert "30 rows" in findings(read(tmp_path, silent))["all zero"]


def test_zeros_for_all_states_are_no_measurement(tmp_path):
    table = swing()
    table.loc[300:319, ["angle", "rate"]] = 0.0
    table.loc[0:4, ["angle", "rate"]] = 0.0  # before the first message
    log = read(tmp_path, table)
    assert findings(log)["all zero"] == "25 rows with zeros for all states: left out"
    assert len(log) == 975
    assert log.runs[0].begins == (0, 295)


def test_a_system_that_starts_from_zero_is_measured(tmp_path):
    t = np.arange(500) * 0.01
    angle = np.where(t < 1, 0.0, 1 - np.cos(2 * (t - 1)))
    rate = np.where(t < 1, 0.0, 2 * np.sin(2 * (t - 1)))
    log = read(tmp_path, swing(500).assign(angle=angle, rate=rate))
    assert (len(log), findings(log)) == (500, {})
    log = read(tmp_path, swing(100).assign(angle=0.0, rate=0.0))
    assert (len(log), findings(log)) == (100, {})


def test_a_single_signal_that_repeats_while_others_move_is_named(tmp_path):
    table = swing()
    table.loc[400:449, "angle"] = table.loc[400, "angle"]
    log = read(tmp_path, table)
    assert "49 rows in which angle stays at its value" in findings(log)["held sensor"]
    table = swing()
    table.loc[700:, "angle"] = table.loc[700, "angle"]
    assert "299 rows in which angle" in findings(read(tmp_path, table))["held sensor"]
    table = swing()
    table["rate"] = table["rate"].iloc[np.arange(1000) // 5 * 5].to_numpy()
    text = findings(read(tmp_path, table))["held sensor"]
    assert "rate changes in 199 of 1000 rows only" in text
    assert findings(read(tmp_path, table, held="use")) == {}


def test_one_frozen_axis_of_a_vector_is_named_as_well(tmp_path):
    table = swing()
    table.loc[400:449, "angle"] = table.loc[400, "angle"]
    log = read(tmp_path, table, states={"both": ["angle", "rate"]})
    assert "49 rows in which angle" in findings(log)["held sensor"]


def test_a_coarse_resolution_or_a_limit_is_no_held_sensor(tmp_path):
    coarse = swing().assign(angle=(swing()["angle"] / 0.2).round() * 0.2)
    assert "held sensor" not in findings(read(tmp_path, coarse))
    clipped = swing().assign(angle=swing()["angle"].clip(upper=0.9))
    assert "held sensor" not in findings(read(tmp_path, clipped))
    assert findings(read(tmp_path, swing())) == {}


@pytest.mark.parametrize("unit", ["degree", "ft", "knots", "deg C", "m/", "rpm/s", "M"])
def test_an_unknown_unit_is_an_error_that_lists_the_known_ones(unit):
    states = {"angle": {"columns": ["angle"], "unit": unit}}
    with pytest.raises(
        SettingError, match=r"angle.unit: .* unknown unit; known are m,"
    ):
        LogMapping.from_dict({**MAPPING, "states": states})


@pytest.mark.parametrize(
    ("unit", "si_unit", "factor"),
    [
        ("deg", "rad", np.pi / 180),
        ("deg/s", "rad/s", np.pi / 180),
        ("rpm", "rad/s", np.pi / 30),
        ("km/h", "m/s", 1 / 3.6),
        ("cm/s2", "m/s2", 1e-2),
        ("mm/s^2", "m/s2", 1e-3),
        ("N mm", "N m", 1e-3),
        ("1/min", "1/s", 1 / 60),
        ("g", "m/s2", 9.80665),
        ("kg m2/s3", "kg m2/s3", 1),
        ("%", "", 1e-2),
        ("-", "", 1),
    ],
)
def test_a_known_unit_is_converted(unit, si_unit, factor):
    states = {"angle": {"columns": ["angle"], "unit": unit}}
    (signal,) = LogMapping.from_dict({**MAPPING, "states": states}).of("states")
    assert signal.group.unit == si_unit
    assert signal.factors == pytest.approx((factor,), rel=1e-15)
