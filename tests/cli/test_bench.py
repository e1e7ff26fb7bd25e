import json

import pytest

from tests.cli.command import forked, gpmpc

SMALL = ["parts=[steps]", "states=[2]", "sizes=[6]", "horizons=[1]", "caches=[hot]", "seconds=0.01"]


def test_a_measurement_is_written_and_two_of_them_become_ratios(tmp_path):
    done = gpmpc("bench", *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "outputs/bench"
    assert {path.name for path in folder.iterdir()} == {"bench.json", "bench.md", "steps.png"}
    assert len(json.loads((folder / "bench.json").read_text())["rows"]) == 7
    assert "paper's form, H = 1" in done.stdout
    path = folder / "bench.json"
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
