"""Slurm's answers, as its commands give them, become what the runs' folders say.

The commands are made up here; ``make cluster`` asks a real Slurm.
"""

import json
import os
import subprocess
import sys

import hydra
import pytest

from gpmpc.cli import _flying, _slurm
from gpmpc.cli._flying import Flying
from gpmpc.cli._settings import settings_folders
from gpmpc.cli._slurm import Slurm, has_jobs
from gpmpc.exceptions import GpmpcError, SettingError
from tests.cli.launched import fly, in_chunks, jobs_of

# They answer from files: `queue` and `accounts` have lines of INDEX|STATE|REASON|HOST,
# and what stands in `logs` is there as soon as an array has been submitted.
SBATCH = """#!/bin/sh
[ -e "$FAKE/refusal" ] && { cat "$FAKE/refusal" >&2; exit 1; }
[ -e "$FAKE/full" ] && [ -e "$FAKE/submitted" ] && {
  rm "$FAKE/full"; echo "sbatch: error: QOSMaxSubmitJobPerUserLimit" >&2; exit 1; }
busy=
[ -e "$FAKE/busy" ] && { busy=$(cat "$FAKE/busy"); rm "$FAKE/busy"; }
[ "$busy" = refuses ] && { echo "Unable to contact slurm controller" >&2; exit 1; }
echo "$@" >> "$FAKE/submitted"
cat > "$FAKE/script"
for word in "$@"; do case "$word" in
  --job-name=*) echo "${word#*=}" >> "$FAKE/names" ;;
  --output=*) folder=$(dirname "${word#*=}") ;;
esac; done
cp "$FAKE"/logs/*.log "$folder" 2> /dev/null
[ -n "$busy" ] && { echo "Socket timed out on send/recv operation" >&2; exit 1; }
echo 7
"""
SQUEUE = """#!/bin/sh
[ -e "$FAKE/silent" ] && { rm "$FAKE/silent"; exit 1; }
[ -e "$FAKE/broken" ] && { echo "squeue: unrecognized option '--me'" >&2; exit 1; }
for name in $(cat "$FAKE/names"); do
  while IFS='|' read -r index rest; do
    echo "$name|$index|7_$index|$rest"
  done < "$FAKE/queue"
done
echo "somebody's|N/A|8_N/A|RUNNING|None|n1"
echo
echo "CLUSTER: other"
"""
SACCT = """#!/bin/sh
[ -e "$FAKE/accounts" ] || exit 1
while IFS='|' read -r index state reason host; do
  echo
  echo "7_$index|$state|$host"
done < "$FAKE/accounts"
"""
SCONTROL = "#!/bin/sh\necho 'MaxArraySize            = 3'\n"
SCANCEL = '#!/bin/sh\necho "$@" >> "$FAKE/cancelled"\n'
KILLED = "slurmstepd-n1: error: *** JOB 7 ON n1 CANCELLED AT 2026-01-02T03:04:05"


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Folder of files that Slurm's commands answer from."""
    programs = tmp_path / "programs"
    fake = tmp_path / "fake"
    (fake / "logs").mkdir(parents=True)
    for name in ("queue", "names"):
        (fake / name).touch()
    programs.mkdir()
    for name, text in {
        "sbatch": SBATCH,
        "squeue": SQUEUE,
        "sacct": SACCT,
        "scontrol": SCONTROL,
        "scancel": SCANCEL,
    }.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE", str(fake))
    monkeypatch.setattr(_slurm, "_FIRST_LOOK", 0.01)
    monkeypatch.setattr(_slurm, "_LAST_LOOK", 0.01)
    monkeypatch.setattr(_flying, "_LATE", 0.0)
    return fake


@pytest.fixture
def tree(tmp_path):
    return tmp_path / "tree"


def outcomes(tree, jobs, size=1, launcher=None, flown_before=()):
    """Flies jobs; those of ``flown_before`` are finished when Slurm is asked."""
    states = {}

    def chunked(open_jobs):
        chunks = in_chunks(size)(open_jobs)
        for chunk in chunks:
            if {job.folder.path.name for job in chunk.jobs} & {*flown_before}:
                fly(chunk)
        return chunks

    Flying(
        launcher=launcher or Slurm(tree),
        work=fly,
        chunked=chunked,
        on_settled=lambda job, state: states.update({job.folder.path: state.value}),
        retries=0,
    ).fly(jobs)
    return [states[job.folder.path] for job in jobs]


@pytest.mark.parametrize(
    ("queue", "accounts", "log", "kind", "words"),
    [
        (
            "0|TIMEOUT|TimeLimit|n1",
            None,
            f"{KILLED} DUE TO TIME LIMIT ***",
            "time",
            "job 7_0 on n1 reached its wall time of 60 min; more by hydra.launcher",
        ),
        ("0|OUT_OF_MEMORY|OutOfMemory|n1", None, "", "memory", "than its 4 GB; more"),
        (
            "0|FAILED|JobLaunchFailure|n1",
            None,
            "slurmstepd-n1: error: Exceeded job memory limit",
            "memory",
            "job 7_0 on n1 needed more than its 4 GB; more by hydra.launcher.mem_gb",
        ),
        ("0|CANCELLED|None|n2", None, f"{KILLED} ***", "cancelled", "7_0 on n2 was"),
        ("0|CANCELLED|Priority|", None, None, "cancelled", "job 7_0 was cancelled"),
        ("0|NODE_FAIL|NodeDown|n2", None, "", "node", "was ended with its node"),
        ("0|PREEMPTED|None|n2", None, "", "node", "preempted"),
        ("", None, None, "cancelled", "was cancelled"),
        ("", None, f"{KILLED} DUE TO TIME LIMIT ***", "time", "wall time of 60 min"),
        (
            "",
            None,
            f"{KILLED} DUE TO JOB REQUEUE ***\nSegmentation fault\n",
            "crash",
            "its log ends: 'Segmentation",
        ),
        ("", None, f"{KILLED} DUE TO NODE FAILURE ***", "node", "with its node"),
        ("", "0|NODE_FAIL||n1", "", "node", "job 7_0 on n1 was ended with its node"),
        ("", "0|CANCELLED by 1000||None assigned", "", "cancelled", "7_0 was cancel"),
        ("", None, "Segmentation fault\n", "crash", "its log ends: 'Segmentation"),
        ("0|FAILED|NonZeroExitCode|n1", None, "", "crash", "nobody says why"),
        (
            "0|FAILED|NonZeroExitCode|n1",
            None,
            "Traceback ...\ngpmpc: error: OSError: no space left\n",
            "error",
            "job 7_0 on n1 failed: OSError: no space left",
        ),
        (
            "0|FAILED|JobLaunchFailure|n2",
            None,
            None,
            "error",
            "left no log (JobLaunchFailure); does the node see",
        ),
        (
            "0|PENDING|launch failed requeued held|",
            None,
            None,
            "error",
            "left no log (launch failed requeued held); does the node see",
        ),
        (
            "0|COMPLETED|None|n2",
            None,
            "gpmpc: done on host2\n",
            "error",
            "n2 says that it flew this run, and it is not in the folder; does n2 see",
        ),
        (
            "",
            None,
            "gpmpc: done on host2\n",
            "error",
            "host2 says that it flew this run, and it is not in the folder",
        ),
    ],
)
def test_a_job_that_slurm_ends_is_a_failed_run_with_the_reason(
    queue, accounts, log, kind, words, fake, tree
):
    (fake / "queue").write_text(queue + "\n")
    if accounts is not None:
        (fake / "accounts").write_text(accounts + "\n")
    if log is not None:
        (fake / "logs" / "0.log").write_text(log)
    (job,) = jobs_of(tree, "flies")
    assert outcomes(tree, [job]) == ["failed"]
    error = json.loads((job.folder.path / "error.json").read_text())
    assert words in error["error"]
    assert "\n" not in error["error"]
    # No run began here: what ended the whole job is no attempt of it.
    attempts = 0 if kind in ("cancelled", "error") else 1
    assert (error["kind"], error["attempts"]) == (kind, attempts)
    cancelled = (fake / "cancelled").exists()
    assert cancelled == ("held" in queue)


def test_jobs_are_submitted_as_arrays_that_slurm_takes(fake, tree):
    (fake / "queue").write_text("0|COMPLETED|None|n1\n1|COMPLETED|None|n2\n")
    jobs = jobs_of(tree, *9 * ["flies"])
    launcher = Slurm(
        tree,
        partition="gpu",
        timeout_min=2,
        mem_gb=0.5,
        setup=["module load python"],
        additional_parameters={"nice": 100, "exclusive": True, "requeue": False},
    )
    names = [job.folder.path.name for job in jobs]
    states = outcomes(tree, jobs, size=2, launcher=launcher, flown_before=names)
    assert states == 9 * ["finished"]
    asked = (fake / "submitted").read_text().splitlines()
    arrays = ["--array=0-1%33", "--array=0-1%33", "--array=0-0%33"]
    for words, array in zip(asked, arrays, strict=True):
        assert array in words
        assert "--time=2 --mem=512M --cpus-per-task=1 --partition=gpu" in words
        assert "--nice=100 --exclusive --job-name" in words
        assert "requeue" not in words
        assert "None" not in words
        assert "signal" not in words
    script = (fake / "script").read_text().splitlines()
    assert "export OMP_NUM_THREADS=1" in script
    assert "module load python" in script
    assert script[-1].endswith('"$SLURM_ARRAY_TASK_ID"')


def run_job(fake):
    """Runs the script of the newest array as its first job."""
    path = os.pathsep.join(filter(None, sys.path))
    return subprocess.run(
        ["/bin/sh"],
        input=(fake / "script").read_text(),
        env=os.environ | {"SLURM_ARRAY_TASK_ID": "0", "PYTHONPATH": path},
        text=True,
        capture_output=True,
        check=True,
    )


def test_a_job_flies_its_chunk_and_says_so(fake, tree):
    (job,) = jobs_of(tree, "flies")
    (chunk,) = in_chunks(1)([job])
    launcher = Slurm(tree)
    launcher.launch(fly, [chunk])
    done = run_job(fake)
    assert done.stderr.startswith("gpmpc: done on ")
    assert job.folder.finished


def test_jobs_of_a_killed_sweep_are_not_flown_twice(fake, tree):
    jobs = jobs_of(tree, "flies", "flies", "flies")
    killed = Slurm(tree, timeout_min=5)
    killed.launch(fly, in_chunks(1)(jobs[:2]))
    (fake / "queue").write_text("0|RUNNING|None|n1\n1|PENDING|Resources|\n")
    again = Slurm(tree)
    paths = {str(job.folder.path) for job in jobs}
    assert len(again.adopt(paths)) == 2
    assert again.adopt({str(jobs[2].folder.path)}) == []

    fly(in_chunks(1)(jobs)[0])
    (fake / "queue").write_text("0|COMPLETED|None|n1\n1|TIMEOUT|TimeLimit|n2\n")
    (fake / "logs" / "0.log").write_text("")
    states = outcomes(tree, jobs, flown_before=["2-flies"])
    assert states == ["finished", "failed", "finished"]
    # the limit is that of the call that submitted it
    assert "wall time of 5 min" in jobs[1].folder.error()
    assert len((fake / "submitted").read_text().splitlines()) == 2
    assert Slurm(tree).adopt(paths) == []


def test_a_failure_before_a_job_was_submitted_is_none_of_its(fake, tree):
    jobs = jobs_of(tree, "flies", "flies")
    jobs[1].folder.path.mkdir(parents=True)
    jobs[1].folder.fail(ValueError("in an earlier call"), {})
    Slurm(tree).launch(fly, in_chunks(2)(jobs))
    fly(in_chunks(1)(jobs)[0])  # it had a long one, and left the other
    (fake / "queue").write_text("0|COMPLETED|None|n1\n")
    (next(tree.glob(".slurm/gpmpc-*")) / "0.log").write_text("gpmpc: done on n1\n")
    assert outcomes(tree, jobs, flown_before=["1-flies"]) == ["finished", "finished"]


def test_who_interrupts_a_sweep_is_told_how_its_jobs_end(fake, tree, capsys):
    def interrupt(job, state):
        raise KeyboardInterrupt

    def chunked(jobs):
        first, second = in_chunks(1)(jobs)
        fly(first)
        return first, second

    jobs = jobs_of(tree, "flies", "flies")
    (fake / "queue").write_text("0|COMPLETED|None|n1\n1|RUNNING|None|n1\n")
    flying = Flying(Slurm(tree), fly, chunked, interrupt, retries=0)
    with pytest.raises(KeyboardInterrupt):
        flying.fly(jobs)
    (array,) = tree.glob(".slurm/gpmpc-*")
    assert f"to end them: scancel -n {array.name}" in capsys.readouterr().err


def test_logs_lie_in_the_folder_whatever_its_name(fake, tmp_path):
    Slurm(tmp_path / "95%u").launch(fly, in_chunks(1)(jobs_of(tmp_path, "flies")))
    assert (
        f"--output={tmp_path}/95%%u/.slurm/gpmpc-" in (fake / "submitted").read_text()
    )


def test_chunks_of_another_gpmpc_are_told_and_left(fake, tree, capsys):
    (job,) = jobs_of(tree, "flies")
    Slurm(tree).launch(fly, in_chunks(1)([job]))
    assert not has_jobs(tree)
    (fake / "queue").write_text("0|PENDING|Resources|\n")
    assert has_jobs(tree)
    (chunks,) = tree.glob(".slurm/*/chunks")
    chunks.write_bytes(b"cgpmpc.cli._slurm\nGone\n.")
    assert Slurm(tree).adopt({str(job.folder.path)}) == []
    assert f"scancel -n {chunks.parent.name}" in capsys.readouterr().err


def test_what_slurm_refuses_behind_others_is_submitted_later(fake, tree, capsys):
    (fake / "full").touch()
    (fake / "queue").write_text("0|COMPLETED|None|n1\n1|COMPLETED|None|n1\n")
    jobs = jobs_of(tree, "flies", "flies", "flies")
    names = [job.folder.path.name for job in jobs]
    assert outcomes(tree, jobs, flown_before=names) == 3 * ["finished"]
    assert "QOSMaxSubmitJobPerUserLimit; what it has taken" in capsys.readouterr().err


def test_without_a_queue_the_logs_tell_which_jobs_are_done(
    fake, tree, monkeypatch, capsys
):
    monkeypatch.setattr(_slurm, "_SILENCE", 0.0)
    (fake / "broken").touch()
    (fake / "logs" / "0.log").write_text("gpmpc: done on n1\n")
    (job,) = jobs_of(tree, "flies")
    assert outcomes(tree, [job], flown_before=["0-flies"]) == ["finished"]
    assert "unrecognized option '--me'" in capsys.readouterr().err


def test_what_was_never_submitted_is_no_job(fake, tree):
    jobs = jobs_of(tree, "flies")
    Slurm(tree).launch(fly, in_chunks(1)(jobs))
    (marked,) = tree.glob(".slurm/*/submitted")
    marked.unlink()
    assert Slurm(tree).adopt({str(jobs[0].folder.path)}) == []


def test_a_slurm_that_does_not_answer_for_a_while_is_waited_for(fake, tree):
    (fake / "silent").touch()
    (fake / "queue").write_text("0|COMPLETED|None|n1\n")
    (job,) = jobs_of(tree, "flies")
    assert outcomes(tree, [job], flown_before=["0-flies"]) == ["finished"]
    assert not (fake / "silent").exists()


def test_a_refused_submission_is_one_line_and_leaves_nothing(fake, tree):
    (fake / "refusal").write_text("sbatch: error: invalid partition\nspecified: gpu\n")
    (job,) = jobs_of(tree, "flies")
    with pytest.raises(
        GpmpcError,
        match="Slurm refuses the sweep: sbatch: error: invalid partition specified",
    ):
        outcomes(tree, [job])
    assert not [*tree.glob(".slurm/gpmpc-*")]


@pytest.mark.parametrize(
    ("answer", "silent"), [("refuses", False), ("takes it", False), ("takes it", True)]
)
def test_a_busy_slurm_gets_an_array_once(answer, silent, fake, tree, monkeypatch):
    monkeypatch.setattr(_slurm, "_WAITS", (0.0,))
    (fake / "busy").write_text(answer)
    if silent:  # at the first look at the queue
        (fake / "silent").touch()
    (fake / "queue").write_text("0|COMPLETED|None|n1\n")
    (job,) = jobs_of(tree, "flies")
    assert outcomes(tree, [job], flown_before=["0-flies"]) == ["finished"]
    assert len((fake / "submitted").read_text().splitlines()) == 1
    (array,) = tree.glob(".slurm/gpmpc-*")
    assert (array / "submitted").read_text() == "7\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"timeout_min": 0}, r"timeout_min: must be a whole number"),
        ({"mem_gb": -1}, r"mem_gb: must be a number above 0"),
        ({"array_parallelism": 0.5}, r"array_parallelism: must be a whole number"),
        ({"setup": "module load x"}, r"setup.* must be a list of lines"),
        ({"setup": ["#SBATCH --exclusive"]}, r"setup.* additional_parameters"),
    ],
)
def test_a_mistake_in_slurms_settings_is_named(arguments, words, fake, tree):
    with pytest.raises(SettingError, match=r"hydra\.launcher\." + words):
        Slurm(tree, **arguments)


def test_the_page_s_settings_are_taken():
    words = [
        "launcher=slurm",
        "hydra.launcher.additional_parameters={nice: 100}",
        "hydra.launcher.setup=[module load python]",
    ]
    with settings_folders():
        launcher = hydra.compose("run", words, return_hydra_config=True).hydra.launcher
    assert launcher.name == "slurm"
    assert launcher.additional_parameters == {"nice": 100}
    assert launcher.setup == ["module load python"]


def test_without_slurm_its_launcher_says_where_to_start(tree, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SettingError, match="start the sweep on a login node"):
        Slurm(tree)


def test_every_command_of_slurm_is_needed(fake, tree, tmp_path, monkeypatch):
    programs = tmp_path / "programs"
    (programs / "squeue").unlink()
    monkeypatch.setenv("PATH", str(programs))
    with pytest.raises(SettingError, match="slurm needs squeue; start the sweep"):
        Slurm(tree)
