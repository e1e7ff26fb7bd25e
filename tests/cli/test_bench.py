import json
import signal
import subprocess
import time

import pytest

from tests.cli.command import PATH, forked, gpmpc

SMALL = ["parts=[steps]", "states=[2]", "sizes=[6]", "horizons=[1]", "caches=[hot]", "seconds=0.01"]


def test_a_measurement_is_written_and_two_of_them_become_ratios(tmp_path):
    done = gpmpc("bench", *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "outputs/bench"
    assert {path.name for path in folder.iterdir()} == {"bench.json", "bench.md", "steps.png"}
    assert len(json.loads((folder / "bench.json").read_text())["rows"]) == 7
    assert "paper's form, H = 1" in done.stdout
    path = folder / "bench.json"
    assert "incomplete" not in json.loads(path.read_text())
    ratios = forked("bench", f"compare=[{path},{path}]", cwd=tmp_path)
    assert "step: new / old 1.00 in the median of 3 rows" in ratios.stdout


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("parts=[nothing]", "parts: must be one or more of steps, peers, quality; got ['nothing']"),
        ("parts=[]", "parts: must be one or more of"),
        ("parts=[[steps]]", "parts: must be one or more of"),
        ("peers=null", "peers: has settings of its own"),
        ("states=[3]", "states: a pendulum has two states, so n is even; got 3"),
        ("compare=[a.json]", "compare: takes two documents"),
        ("compare=[a.json,b.json]", "cannot read a.json"),
    ],
)
def test_a_mistake_is_one_clear_line_and_leaves_nothing_behind(setting, message, tmp_path):
    done = forked("bench", "parts=[steps]", setting, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def results(folder):
    """Every measured group's rows, by what was kept of it."""
    lines = map(json.loads, (folder / "bench.incomplete.jsonl").read_text().splitlines())
    return {line["fingerprint"]: line["record"]["result"] for line in lines if line["fingerprint"] != "identity"}


def stopped(arguments, cwd, groups, number):
    """Exit code and standard error of a measurement that gets a signal when so many groups are kept."""
    kept = cwd / "outputs/bench/bench.incomplete.jsonl"
    process = subprocess.Popen(
        [PATH, *arguments], cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 200
    while not (kept.exists() and kept.read_text().count("\n") > groups) and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(number)
    _, told = process.communicate()
    return process.returncode, told


def test_a_stopped_measurement_goes_on_where_it_was_and_looks_finished_only_then(tmp_path):
    longer, folder = ["bench", *SMALL, "sizes=[6,8]", "horizons=[1,2,3]"], tmp_path / "outputs/bench"
    assert stopped(longer, tmp_path, 2, signal.SIGKILL)[0] == -signal.SIGKILL
    before = results(folder)
    assert 2 <= len(before) < 8
    (folder / ".bench.incomplete.json.1.partial").touch()  # as a kill in the middle of writing leaves it
    code, told = stopped(longer, tmp_path, len(before) + 1, signal.SIGINT)
    assert (code, told.strip()) == (130, "interrupted; the same command goes on where it stopped")
    found = results(folder)
    assert len(before) < len(found) < 8
    assert {name: found[name] for name in before} == before
    assert {path.name for path in folder.iterdir()} == {
        f"bench.incomplete.{ending}" for ending in ("json", "jsonl", "md")
    }
    path = folder / "bench.incomplete.json"
    half = json.loads(path.read_text())
    assert half["incomplete"]["steps"][1] == 8
    told = forked("bench", f"compare=[{path},{path}]", cwd=tmp_path)
    assert "old is incomplete, groups measured: steps" in told.stdout

    done = gpmpc(*longer, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    began = half["sittings"][0]["created"]
    assert f"going on: kept are the groups measured since {began}: steps {len(found)} of 8" in done.stdout
    assert {path.name for path in folder.iterdir()} == {"bench.json", "bench.md", "steps.png"}
    whole = json.loads((folder / "bench.json").read_text())
    assert "incomplete" not in whole
    measured = [sitting["groups"] for sitting in whole["sittings"]]
    assert measured == [len(before), len(found) - len(before), 8 - len(found)]
    rows = [row for group in found.values() for row in group]
    assert whole["rows"][: len(rows)] == rows
    assert len(whole["rows"]) == 2 * (4 + 3 * 3)
