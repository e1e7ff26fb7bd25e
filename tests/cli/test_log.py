"""``gpmpc log`` as a user meets it."""

import csv
import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

sys.path.append(str(Path(__file__).resolve().parents[1] / "recording"))
import damage
import runs

from gpmpc.recording import layout, read_run
from tests.cli.command import called, forked


def gpmpc_log(*arguments, cwd):
    return forked("log", *arguments, cwd=cwd, COLUMNS="160")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished run, the same cut off, and a file that is none."""
    folder = tmp_path_factory.mktemp("runs")
    runs.record_run(folder / "run.mcap", steps=10)
    data = (folder / "run.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(data[:-100])
    (folder / "notes.mcap").write_text("these are notes")
    return folder


def test_info_shows_channels_counts_metadata_and_statuses(folder):
    result = gpmpc_log("info", "run.mcap", cwd=folder)
    assert result.returncode == 0, result.stderr
    for text in (
        "run.mcap: finished",
        "/step",
        "gpmpc.Step",
        "vx [m/s]",
        "SOLVED 10",
        "10 kept for replay",
        "0 to 0.9 s",
    ):
        assert text in result.stdout
    assert (
        "cut.mcap: unfinished or damaged"
        in gpmpc_log("info", "cut.mcap", cwd=folder).stdout
    )


def test_a_table_of_an_unfinished_recording_says_that_it_is_one(folder):
    assert "unfinished or damaged" in gpmpc_log("export", "cut.mcap", cwd=folder).stdout
    assert "unfinished" not in gpmpc_log("export", "run.mcap", cwd=folder).stdout


def test_recover_writes_a_finished_file_beside_the_broken_one(folder):
    result = gpmpc_log("recover", "cut.mcap", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("written to cut.recovered.mcap: ")
    assert len(read_run(folder / "cut.recovered.mcap").times) == 10
    shown = gpmpc_log("info", "cut.recovered.mcap", cwd=folder).stdout
    assert (
        "cut.recovered.mcap: unfinished or damaged; this is what could be read\n"
        in shown
    )


def chunk_starts(data):
    return [start for kind, start, _ in damage._spans(data) if kind == damage.CHUNK]


def spoil(data, starts):
    """The file with a wrong byte in every chunk that starts there."""
    changed = bytearray(data)
    for start in starts:
        changed[start + 200] ^= 0xFF
    return bytes(changed)


def test_recovering_a_recording_without_a_step_writes_no_file(folder, tmp_path):
    data = (folder / "run.mcap").read_bytes()
    starts = chunk_starts(data)
    (tmp_path / "spoiled.mcap").write_bytes(spoil(data, starts))
    (tmp_path / "early.mcap").write_bytes(data[: starts[0]])
    before = sorted(tmp_path.iterdir())
    reasons = {
        "spoiled.mcap": "no step of it can be read: 2 of 2 chunks cannot be read",
        "early.mcap": "holds no step (it was not finished: it has no end)\n",
    }
    for name, reason in reasons.items():
        result = gpmpc_log("recover", name, cwd=tmp_path)
        assert result.returncode == 2
        assert result.stderr.startswith(f"gpmpc: {name}: {reason}")
        assert result.stderr.count("\n") == 1
        assert result.stdout == ""
    assert sorted(tmp_path.iterdir()) == before


def test_a_recording_without_steps_is_an_error_of_every_command(folder, tmp_path):
    data = (folder / "run.mcap").read_bytes()
    (tmp_path / "early.mcap").write_bytes(data[: chunk_starts(data)[0]])
    for command in ("recover", "export", "layout"):
        result = called("log", command, "early.mcap", cwd=tmp_path)
        assert result.returncode == 2
        assert result.stderr.startswith("gpmpc: early.mcap: holds no step")
        assert result.stderr.count("\n") == 1
    result = gpmpc_log("info", "early.mcap", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr == "gpmpc: early.mcap: holds no step\n"
    assert "vx [m/s]" in result.stdout


def test_every_command_says_what_is_lost(folder, tmp_path):
    data = (folder / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(spoil(data, chunk_starts(data)[1:]))
    lost = "5 of 10 steps are lost: after step 4"
    for command in ("info", "export", "recover"):
        result = gpmpc_log(command, "run.mcap", cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        assert "1 of 2 chunks cannot be read" in result.stdout
        assert lost in result.stdout
    assert "unfinished or damaged" in gpmpc_log("info", "run.mcap", cwd=tmp_path).stdout


def test_every_command_says_that_there_are_no_checksums(folder, tmp_path):
    changed = []
    for kind, content in damage.records((folder / "run.mcap").read_bytes()[8:]):
        if kind == damage.CHUNK:
            content = content[:24] + bytes(4) + content[28:]
        changed.append((kind, bytes(4) if kind == damage.DATA_END else content))
    data = damage.MAGIC + damage.joined(changed) + damage.MAGIC
    (tmp_path / "run.mcap").write_bytes(data)
    for command in ("info", "export", "recover"):
        result = gpmpc_log(command, "run.mcap", cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        assert "no checksums: 90 messages may be altered unnoticed" in result.stdout
        assert "unfinished or damaged" not in result.stdout


def test_export_writes_a_row_per_step_with_exact_numbers(folder):
    result = gpmpc_log("export", "run.mcap", cwd=folder)
    assert result.returncode == 0, result.stderr
    run = read_run(folder / "run.mcap")
    with (folder / "run.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["state.vx"]) for row in rows] == run.states[:, 1].tolist()
    assert rows[0]["status"] == "SOLVED"
    assert rows[0]["innovation.x"] == "nan"
    assert list(rows[0]) == list(run.columns)


@pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None,
    reason="the extra 'report' is not installed",
)
def test_export_writes_parquet(folder):
    import pandas

    assert gpmpc_log("export", "run.mcap", "run.parquet", cwd=folder).returncode == 0
    frame = pandas.read_parquet(folder / "run.parquet")
    np.testing.assert_array_equal(
        frame["state.vx"], read_run(folder / "run.mcap").states[:, 1]
    )


def test_layout_writes_what_foxglove_imports(folder):
    result = gpmpc_log("layout", "run.mcap", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(
        "written to run.layout.json: open run.mcap in Foxglove"
    )
    assert (folder / "run.layout.json").read_text() == layout(
        read_run(folder / "run.mcap")
    )


def foreign(folder):
    """Files and other things that are no recordings, by name."""
    (folder / "empty.mcap").touch()
    (folder / "picture.mcap").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    (folder / "folder.mcap").mkdir()
    os.mkfifo(folder / "pipe.mcap")
    with (folder / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(
            "/step", "json", writer.register_schema("step", "jsonschema", b"{}")
        )
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    data = (folder / "run.mcap").read_bytes()
    (folder / "nameless.mcap").write_bytes(data.replace(b"state_names", b"\xff" * 11))
    (folder / "renamed.mcap").write_bytes(
        data.replace(b"x vx y vy z vz", b"x vx y vy z 1z")
    )
    return {
        "empty.mcap": "is empty",
        "picture.mcap": "is not an MCAP file",
        "folder.mcap": "is not a file",
        "pipe.mcap": "is not a file",
        "other.mcap": "is not the recording of a run",
        "nameless.mcap": "is not the recording of a run",
        "renamed.mcap": "a name must be letters, digits and _, a letter first; got "
        "'1z'",
        ".": "is not a file",
        "/dev/zero": "is not a file",
        "n" * 300: "File name too long",
    }


def test_what_is_no_recording_is_refused_by_its_name(folder, tmp_path):
    (tmp_path / "run.mcap").write_bytes((folder / "run.mcap").read_bytes())
    reasons = foreign(tmp_path)
    before = sorted(tmp_path.iterdir())
    for name, reason in reasons.items():
        for command in ("info", "recover", "export", "layout"):
            result = called("log", command, name, cwd=tmp_path)
            assert result.returncode == 2
            assert result.stderr.startswith(f"gpmpc: {name}")
            assert reason in result.stderr
            assert result.stderr.count("\n") == 1
        assert sorted(tmp_path.iterdir()) == before
    result = gpmpc_log("info", "other.mcap", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith("gpmpc: other.mcap: is not the recording of a run")
    assert result.stderr.count("\n") == 1


def test_info_prints_nothing_that_a_terminal_would_obey(tmp_path):
    runs.record_run(
        tmp_path / "run.mcap", steps=1, metadata={"note": "\x1b[31m\x07\x1b]0;title"}
    )
    result = gpmpc_log("info", "run.mcap", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "]0;title" in result.stdout
    assert not {"\x1b", "\x07"} & set(result.stdout)


MISTAKES = [
    (
        ["info", "missing.mcap"],
        "missing.mcap: cannot be read: No such file or directory",
    ),
    (["info", "notes.mcap"], "notes.mcap: is not an MCAP file"),
    (["recover", "notes.mcap"], "notes.mcap: is not an MCAP file"),
    (
        ["recover", "run.mcap", "run.mcap"],
        "run.mcap: a file cannot be recovered into itself",
    ),
    (["recover", "run.mcap", "."], ".: cannot be written: "),
    (
        ["recover", "run.mcap", "nowhere/run.mcap"],
        "nowhere/run.mcap: cannot be written: No such file",
    ),
    (
        ["export", "run.mcap", "run.xlsx"],
        "output: must end in .csv or .parquet; got 'run.xlsx'",
    ),
    (
        ["export", "run.mcap", "nowhere/run.csv"],
        "output: cannot write to nowhere/run.csv: No such file",
    ),
    (["layout", "run.mcap", "run.yaml"], "output: must end in .json; got 'run.yaml'"),
    (["show", "run.mcap"], "invalid choice: 'show'"),
    (["info", "run.mcap", "--time", "t"], "--time: is for log inspect; got log info"),
    (["info"], "the following arguments are required: file"),
    ([], "the following arguments are required: action, file"),
]
if importlib.util.find_spec("pandas") is None:
    MISTAKES.append(
        (["export", "run.mcap", "run.parquet"], "pandas: pip install 'gpmpc[report]'")
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    MISTAKES,
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_a_mistake_is_one_clear_line(folder, arguments, message):
    result = gpmpc_log(*arguments, cwd=folder)
    assert result.returncode == 2
    assert result.stderr.startswith("gpmpc: ")
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_folder_of_runs_is_drawn_and_a_damaged_run_named(tmp_path):
    for name in ("a", "b"):
        runs.record_run(tmp_path / name / "run.mcap", steps=3)
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "run.mcap").touch()
    done = forked("plot", str(tmp_path), "--no-animation", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("gpmpc: ")]
    assert "c/run.mcap: is empty" in line
    for name in ("a", "b"):
        assert (tmp_path / name / "figures" / "tracking.png").exists()
    (tmp_path / "d").mkdir()
    done = forked("plot", "d", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (
        2,
        "gpmpc: d: holds no run.mcap, nor does a folder below it\n",
    )
