"""Every Python block of the guide runs, in order, on the files of the example."""

import re
import runpy
from pathlib import Path

import yaml

from gpmpc.logs import LogMapping
from tests.cli.command import called

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "guide_log.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_guide_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    example = runpy.run_path(str(ROOT / "examples" / "own_log.py"))
    for number, flight in enumerate(example["simulate_flights"](3, 200), start=1):
        flight.to_csv(tmp_path / f"flight_{number}.csv", index=False)
    monkeypatch.chdir(tmp_path)
    names = {"MAPPING": example["MAPPING"]}
    for block in blocks("python"):
        exec(block, names)
    assert names["fit"].to_rows()[0][0] == "thrust"
    assert "Log(600 rows, 3 runs" in capsys.readouterr().out


def test_the_commands_and_the_mapping_of_the_guide_exist(tmp_path):
    assert LogMapping.from_dict(yaml.safe_load(blocks("yaml")[0])).model == "rigid_body"
    commands = called("help", cwd=tmp_path).stdout
    for line in "".join(blocks("bash")).splitlines():
        program, command, *_ = line.split()
        assert program == "gpmpc"
        assert f"\n  {command} " in commands
