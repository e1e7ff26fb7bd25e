"""An inspection finds delays, noise, repeated values, gaps and idle inputs of a log."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest

from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, inspect_log, load_learned
from gpmpc.plotting import inspection_figure, png

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.cli.command import forked

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(0)
    rows = 12_000
    motion = np.convolve(rng.normal(size=rows + 200), np.hanning(30), "same")
    signal = motion[100:-100]
    return pandas.DataFrame(
        {
            "t": 0.004 * np.arange(rows),
            "a": signal,
            "late": 1e-4 * motion[93:-107],
            "noisy": rng.normal(0, 0.5, rows) + 3 * np.sin(0.001 * np.arange(rows)),
            "slow": np.repeat(rng.normal(size=rows // 10), 10),
            "u": 2 * signal + 1e-3 * rng.normal(size=rows),
        }
    )


def test_what_was_put_in_is_found(table, tmp_path):
    table = table.drop(index=range(5000, 5075))
    table.loc[7000, "t"] = table.loc[6999, "t"]
    table.to_csv(tmp_path / "log.csv", index=False)
    inspection = inspect_log(tmp_path / "log.csv")
    stream = inspection.streams.iloc[0]
    # A row that is left out leaves a gap.
    assert (stream["rows"], stream["gaps"]) == (11_925, 2)
    assert (stream["repeated stamps"], stream["backward stamps"]) == (1, 0)
    assert stream["rate [Hz]"] == pytest.approx(250)
    assert stream["longest gap [s]"] == pytest.approx(0.304)
    assert stream["jitter"] < 0.1
    noisy = inspection.channels.loc["noisy"]
    assert noisy["white noise"] == pytest.approx(0.5, rel=0.05)
    assert noisy["smoothness"] == pytest.approx(-2 / 3, abs=0.03)
    assert "a: smoothed: its errors hang together over rows" in inspection.warnings
    assert "slow: a new value every 10.0 rows" in inspection.warnings
    delay = inspection.delays.set_index(["channel", "later channel"]).loc[("a", "late")]
    assert delay["rows"] == 7
    assert delay["agreement"] > 0.9
    assert len(png(inspection_figure(inspection), dpi=50)) > 5000


def test_an_input_that_follows_the_states_is_named(table, tmp_path):
    table.to_csv(tmp_path / "log.csv", index=False)
    mapping = LogMapping.from_dict(
        {"time": "t", "states": {"x": ["a"]}, "inputs": {"u": ["u"], "free": ["noisy"]}}
    )
    inspection = inspect_log(tmp_path / "log.csv", mapping)
    assert inspection.follows["u"] > 0.99
    assert inspection.follows["noisy"] < 0.1
    assert any("u follows the states" in warning for warning in inspection.warnings)
    table.drop(columns="t").to_csv(tmp_path / "bare.csv", index=False)
    bare = inspect_log(tmp_path / "bare.csv")
    assert np.isnan(bare.streams.loc[0, "rate [Hz]"])
    assert any("values stand over their rows" in text for text in bare.warnings)
    timed = inspect_log(tmp_path / "bare.csv", time_step=0.004)
    assert timed.streams.loc[0, "rate [Hz]"] == pytest.approx(250)
    with pytest.raises(DataError, match="column 'clock' is missing"):
        inspect_log(tmp_path / "bare.csv", time="clock")
    with pytest.raises(SettingError, match="must stand in the mapping"):
        inspect_log(tmp_path / "bare.csv", mapping, time="a")


def test_few_rows_do_not_make_an_input_follow_its_states(tmp_path):
    rng = np.random.default_rng(0)
    names = [f"x{i}" for i in range(12)]
    table = pandas.DataFrame(rng.normal(size=(30, 12)), columns=names)
    table.insert(0, "t", 0.1 * np.arange(30))
    table.assign(u=rng.normal(size=30)).to_csv(tmp_path / "log.csv", index=False)
    mapping = {"time": "t", "states": {"x": names}, "inputs": {"u": ["u"]}}
    inspection = inspect_log(tmp_path / "log.csv", LogMapping.from_dict(mapping))
    assert inspection.follows["u"] < 0.7


def test_booleans_and_numbers_in_texts_are_channels(tmp_path):
    lines = [f"{k / 10};{k % 3 > 0};{k % 7}\n" for k in range(90)]
    (tmp_path / "log.csv").write_text("t;enabled;x\n" + "".join(lines) + "9;True;0,5\n")
    inspection = inspect_log(tmp_path / "log.csv")
    assert list(inspection.channels.index) == ["enabled", "x"]
    assert not [text for text in inspection.warnings if "no numbers" in text]


def test_the_command_writes_a_page(table, tmp_path):
    table.to_csv(tmp_path / "log.csv", index=False)
    result = forked("log", "inspect", "log.csv", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "late comes 7 rows after a" in result.stdout
    page = (tmp_path / "log.inspection.html").read_text()
    assert "Delays between correlated channels" in page
    missing = forked("log", "inspect", "no.csv", cwd=tmp_path)
    assert (missing.returncode, missing.stderr) == (2, "gpmpc: no.csv: no such file\n")


BROKEN = {
    "constant stamps": (lambda t: t.assign(t=3.0), "holds a single stamp"),
    "one row": (lambda t: t[:1], "holds a single stamp"),
    "time alone": (lambda t: t[["t"]], "no channel of numbers"),
    "text alone": (
        lambda t: pandas.DataFrame({"t": t["t"], "mode": "hover", "note": "-"}),
        "2 columns hold no numbers: mode, note",
    ),
    "no value at all": (lambda t: t.assign(a=np.nan), "a: holds no value"),
    "infinite values": (
        lambda t: t.assign(a=t["a"].where(t.index % 3 > 0, np.inf)),
        "a: 33.3% of the values are missing",
    ),
    "values without a square": (lambda t: t.assign(a=1e200 * t["a"]), "smoothed"),
    "stamps without order": (
        lambda t: t.sample(frac=1, random_state=0),
        "backward stamps",
    ),
    "half of the stamps missing": (
        lambda t: t.assign(t=t["t"].where(t.index % 2 > 0)),
        "missing stamps",
    ),
    "text for stamps": (lambda t: t.assign(t="noon"), "missing stamps"),
    "a stamp of another age": (
        lambda t: t.assign(t=t["t"].where(t.index < t.index[-1], 2147483647.0)),
        "1 gaps, up to 2.15e+09 s",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_log_is_inspected_all_the_same(table, tmp_path, name):
    spoil, remark = BROKEN[name]
    spoil(table[:3000]).to_csv(tmp_path / "log.csv", index=False)
    inspection = inspect_log(tmp_path / "log.csv")
    assert any(remark in warning for warning in inspection.warnings), (
        inspection.warnings
    )
    assert len(png(inspection_figure(inspection), dpi=30)) > 500


def test_the_page_of_many_channels_says_how_many_it_draws(tmp_path):
    values = np.random.default_rng(0).normal(size=(200, 30))
    table = pandas.DataFrame(values, columns=[f"c{i}" for i in range(30)])
    table.to_csv(tmp_path / "log.csv", index=False)
    figure = inspection_figure(inspect_log(tmp_path / "log.csv"))
    assert "the first 24 of 30 channels" in figure.get_suptitle()


def test_a_broken_log_becomes_a_page_too(tmp_path):
    (tmp_path / "log.csv").write_text("t\n0.0\n0.1\n")
    result = forked("log", "inspect", "log.csv", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    assert "no channel of numbers" in (tmp_path / "log.inspection.html").read_text()


def test_what_holds_for_hundreds_of_channels_is_one_line(tmp_path):
    still = {f"esc[{i}]": 1.0 for i in range(300)}
    slow = {f"slow[{i}]": np.arange(100) // 10 * 1.5 for i in range(5)}
    table = pandas.DataFrame({"t": 0.01 * np.arange(100), **still, **slow, "x": 0.0})
    table.to_csv(tmp_path / "log.csv", index=False)
    assert inspect_log(tmp_path / "log.csv").warnings == (
        "esc[0], esc[1], esc[2] and 298 more channels: never changes",
        "slow[0], slow[1], slow[2] and 2 more channels: a new value every few rows "
        "only",
    )


def test_delays_are_looked_for_between_some_channels_of_many(tmp_path):
    values = np.random.default_rng(0).normal(size=(1700, 66)).round(3)
    values[:, [1, 65]] = np.roll(values[:, [0, 0]], 3, axis=0)
    table = pandas.DataFrame(values, columns=[f"c{i}" for i in range(66)])
    table.insert(0, "t", 0.01 * np.arange(1700))
    table.insert(1, "still", 1.0)
    np.savez(tmp_path / "log.npz", **{name: table[name] for name in table})
    inspection = inspect_log(tmp_path / "log.npz")
    assert inspection.delays["later channel"].tolist() == ["c1"]
    assert any(
        "the first 64 of 66 channels that move" in text for text in inspection.warnings
    )


def test_a_log_that_contradicts_its_mapping_is_inspected(table, tmp_path):
    table.assign(u=0.0).to_csv(tmp_path / "log.csv", index=False)
    mapping = LogMapping.from_dict(
        {"time": "t", "states": {"x": ["a"]}, "inputs": {"u": ["u"]}}
    )
    inspection = inspect_log(tmp_path / "log.csv", mapping)
    assert inspection.follows == {}
    assert any("no input changes" in text for text in inspection.warnings)
    table.assign(u=0.0, a=0.0).to_csv(tmp_path / "log.csv", index=False)
    inspection = inspect_log(tmp_path / "log.csv", mapping)
    assert any("cannot be learned from: " in text for text in inspection.warnings)


def test_each_run_of_a_column_has_its_own_clock(tmp_path):
    t = 0.1 * np.arange(100)
    table = pandas.DataFrame({"t": [*t, *t], "x": np.sin([*t, *(t + 1)]), "u": 0.0})
    table["flight"] = np.repeat([7, 8], 100)
    table.to_csv(tmp_path / "log.csv", index=False)
    mapping = {"time": "t", "states": {"x": ["x"]}, "inputs": {"u": ["u"]}}
    by_run = LogMapping.from_dict({**mapping, "run": "flight"})
    streams = inspect_log(tmp_path / "log.csv", by_run).streams.set_index("stream")
    assert list(streams.index) == ["7", "8"]
    assert not streams[["repeated stamps", "backward stamps", "gaps"]].any(axis=None)
    # Where no row names a run, the page is made, and says so.
    table.assign(flight="").to_csv(tmp_path / "log.csv", index=False)
    inspection = inspect_log(tmp_path / "log.csv", by_run)
    assert any("names no run in any row" in text for text in inspection.warnings)
    assert inspection.streams["repeated stamps"].sum() == 100


def test_learn_writes_its_three_files_and_names_mistakes(tmp_path):
    import yaml

    example = runpy.run_path(str(ROOT / "examples" / "own_log.py"))
    for number, flight in enumerate(example["simulate_flights"](2, 250)):
        flight.to_csv(tmp_path / f"{number}.csv", index=False)
    (tmp_path / "map.yaml").write_text(
        yaml.safe_dump(example["MAPPING"], sort_keys=False)
    )
    arguments = [
        "map.yaml",
        "0.csv",
        "1.csv",
        "--points",
        "20",
        "--steps",
        "10",
        "--held-out",
        "1",
    ]
    result = forked("learn", *arguments, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "loses: " in result.stdout or "ridge" in result.stdout
    written = {path.name for path in (tmp_path / "learned").iterdir()}
    documents = {
        "report.md",
        "report.csv",
        "report.tex",
        "report.html",
        "report.png",
        "card.md",
    }
    assert written == documents | {"model.safetensors", "progress.json"}
    card = (tmp_path / "learned" / "card.md").read_text()
    assert "What must not be trusted" in card
    assert "| thrust |" in card
    wrong = forked(
        "learn", "map.yaml", "0.csv", "1.csv", "--held-out", "7", cwd=tmp_path
    )
    assert (wrong.returncode, wrong.stderr) == (
        2,
        "gpmpc: held_out: no such run '7'; there are 0, 1\n",
    )


def test_documents_of_somebody_else_are_left_alone(tmp_path):
    page = tmp_path / "notes" / "report.md"
    page.parent.mkdir()
    page.write_text("mine")
    result = forked("learn", "map.yaml", "a.csv", "--to", "notes", cwd=tmp_path)
    expected = (
        "gpmpc: --to: would go over report.md, beside which there is no "
        "model.safetensors: name another folder; got notes\n"
    )
    assert (result.returncode, result.stderr) == (2, expected)
    assert page.read_text() == "mine"


def write_short_run(folder, rows):
    """Writes a file of rows without sense, and its mapping."""
    lines = [f"{0.1 * k},{k % 7},{k % 5}" for k in range(rows)]
    (folder / "short.csv").write_text("\n".join(["t,x,u", *lines, ""]))
    (folder / "map.yaml").write_text("time: t\nstates: {x: [x]}\ninputs: {u: [u]}")


def test_stages_of_other_code_are_gone_through_again(tmp_path):
    write_short_run(tmp_path, rows=60)
    arguments = ["learn", "map.yaml", "short.csv", "--points", "10"]
    result = forked(*arguments, cwd=tmp_path)
    assert result.returncode in (0, 3), result.stderr
    assert "learned anew" not in result.stdout
    progress = tmp_path / "learned" / "progress.json"
    stored = json.loads(progress.read_text())
    stages = dict.fromkeys(stored["stages"], "of another version")
    progress.write_text(json.dumps({"fingerprint": "0", "stages": stages}))
    anew = forked(*arguments, cwd=tmp_path)
    assert anew.returncode == result.returncode, anew.stderr
    assert "learned/progress.json: is of other code of gpmpc than this" in anew.stdout
    assert json.loads(progress.read_text()) == stored


def test_runs_that_are_too_short_to_judge_on_are_refused_first(tmp_path):
    write_short_run(tmp_path, rows=50)
    result = forked("learn", "map.yaml", "short.csv", cwd=tmp_path)
    expected = (
        "gpmpc: learning needs 54 rows without a gap; the longest piece to learn from "
        "has 48: log longer runs, or resample over gaps (rate and max_gap)\n"
    )
    assert (result.returncode, result.stderr) == (2, expected)
    assert not (tmp_path / "learned").exists()
    # A few rows more are learned from, and judged as far ahead as they tell.
    write_short_run(tmp_path, rows=60)
    result = forked("learn", "map.yaml", "short.csv", "--for-control", cwd=tmp_path)
    assert result.returncode in (0, 3), result.stderr
    assert "short log: rollouts of 2 steps decide, not of 50" in result.stdout
    assert "at most 1 steps ahead: of predictions more than 1 step" in result.stdout
    assert "Judged 1 ahead" in (tmp_path / "learned" / "report.md").read_text()
    reasons = load_learned(tmp_path / "learned" / "model.safetensors").reasons
    shown = [f"gpmpc: do not use this model: {reason}" for reason in reasons]
    assert [line for line in result.stderr.splitlines() if line in shown] == shown
    assert (result.returncode == 3) == bool(reasons)
