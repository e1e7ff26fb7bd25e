"""The surroundings of a command: pipes, full disks, lost folders, Ctrl-C, TAB, help."""

import fcntl
import json
import logging
import os
import pty
import select
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time
from types import SimpleNamespace

import pytest

from gpmpc.cli import _main
from gpmpc.cli._commands import COMMANDS
from gpmpc.cli._completion import candidates
from gpmpc.cli._run import _was_interrupted
from gpmpc.cli._terminal import Output, OutputEnded, logging_console
from gpmpc.exceptions import GpmpcError
from tests.cli.command import PATH, SECONDS, forked

TINY = ["data.samples=25", "model.restarts=0", "steps=2", "horizon=1", "recorder=none"]


def shell(line, cwd, **environment):
    """A line of the shell, in which $GPMPC is the command."""
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", line],
        cwd=cwd,
        capture_output=True,
        timeout=SECONDS,
        check=False,
        encoding="utf-8",
        errors="replace",
        env=os.environ | {"GPMPC": PATH} | environment,
    )


@pytest.mark.parametrize("command", ["--help", "run --cfg", "log --help"])
def test_a_full_standard_output_ends_the_command_in_one_line(command, tmp_path):
    full = shell(f"$GPMPC {command} > /dev/full", tmp_path)
    assert (full.returncode, full.stderr) == (
        1,
        "gpmpc: cannot write to the standard output: No space left on device\n",
    )
    pipe = shell(f"$GPMPC {command} | true", tmp_path)
    assert (pipe.returncode, pipe.stderr) in (
        (1, ""),
        (0, ""),
    )  # all may have been written before true ended


def test_code_of_the_user_s_that_ends_the_process_is_a_mistake(monkeypatch):
    """Where the output takes nothing any more, that is no fault of the run."""

    def end(error):
        raise error

    monkeypatch.setattr(_main, "import_module", lambda _: SimpleNamespace(calls=end))
    with pytest.raises(GpmpcError, match=r"ended the process \(exit None\)"):
        _main._call("any", "calls", SystemExit())
    with pytest.raises(OutputEnded):
        _main._call("any", "calls", OutputEnded(1))


def test_closed_streams_and_those_of_other_letters_do_no_harm(tmp_path):
    assert shell("$GPMPC run --cfg >&-", tmp_path).returncode == 0
    assert shell("$GPMPC run nope=1 2>&-", tmp_path).returncode == 2
    for code in ("ascii", "latin-1", "utf-8"):
        done = shell(
            "$GPMPC report $'n\\xc3\\xb6\\xe2\\x82\\xac\\xff'",
            tmp_path,
            PYTHONIOENCODING=code,
        )
        assert (
            done.returncode,
            done.stderr.count("\n"),
            "no such folder" in done.stderr,
        ) == (2, 1, True)


def test_a_failed_write_is_not_taken_for_an_error_of_a_file():
    with open("/dev/full", "w") as full:
        output = Output(full)
        output.write("text")
        with pytest.raises(SystemExit):
            output.flush()
        assert output.broken
        output.flush()  # what is left goes nowhere, and nothing is raised twice


@pytest.mark.parametrize("command", ["run", "run -m seed=1,2", "report here"])
def test_a_working_folder_that_is_gone_is_one_line(command, tmp_path):
    done = shell(
        f"mkdir gone; cd gone; rmdir ../gone; exec $GPMPC {command} 2>&1 >/dev/null",
        tmp_path,
    )
    assert done.returncode == 2
    assert done.stdout.count("\n") == 1
    assert "gone" in done.stdout or "here: no such folder" in done.stdout


INTERRUPT = (
    "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(5)"
)
BREAKS = {
    "at once": INTERRUPT,
    "inside a library that makes an error of its own of it": f"""
try:
    {INTERRUPT}
except KeyboardInterrupt:
    raise ImportError("multiarray failed to import")
""",
    "inside a finaliser": f"""
class Library:
    def __del__(self):
        {INTERRUPT}
Library()
import time
time.sleep(5)
""",
}


@pytest.mark.parametrize("broken", BREAKS)
@pytest.mark.parametrize(
    ("command", "library"),
    [("run", "hydra"), ("plot nothing", "matplotlib"), ("report nothing", "rich")],
)
def test_ctrl_c_while_libraries_are_imported_is_one_line(
    command, library, broken, tmp_path
):
    (tmp_path / f"{library}.py").write_text(BREAKS[broken])
    done = shell(f"exec $GPMPC {command}", tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stderr) == (130, "\ninterrupted\n")


def test_who_ignores_ctrl_c_is_not_interrupted(tmp_path):
    (tmp_path / "rich.py").write_text(
        "import os, signal; os.kill(os.getpid(), signal.SIGINT); os._exit(7)"
    )
    done = shell(
        "trap '' INT; $GPMPC report nothing", tmp_path, PYTHONPATH=str(tmp_path)
    )
    assert done.returncode == 7


@pytest.mark.parametrize("command", ["run", "report"])
def test_help_is_found_before_and_behind_a_command(command, tmp_path):
    answers = [
        forked(*words, cwd=tmp_path)
        for words in (["help", command], [command, "--help"])
    ]
    assert {(each.returncode, each.stdout, each.stderr) for each in answers} == {
        (0, answers[0].stdout, "")
    }
    assert f"gpmpc {command}" in answers[0].stdout


def test_the_version_names_what_computes_at_every_place(tmp_path):
    versions = {
        forked(*words, cwd=tmp_path).stdout
        for words in (["--version"], ["run", "--version"], ["plot", "-V"])
    }
    (version,) = versions
    named = dict(line.split(maxsplit=1) for line in version.splitlines())
    assert {"gpmpc", "python", "torch", "numba", "BLAS", "CPU"} <= set(named)
    assert (
        json.loads(forked("version", "--json", cwd=tmp_path).stdout)["torch"]
        == named["torch"]
    )


def test_standard_output_holds_only_json_and_nothing_if_quiet(tmp_path):
    run = ["run", *TINY, "folder=tree"]
    flown = forked(*run, "--json", cwd=tmp_path)
    assert flown.returncode == 0, flown.stderr
    result = json.loads(flown.stdout)
    assert result["steps"] == 2
    assert (
        json.loads((tmp_path / result["folder"] / "metrics.json").read_text())["rmse"]
        == result["rmse"]
    )
    assert "RMSE [m]" in flown.stderr
    as_data = forked(*run, "--quiet", "--json", cwd=tmp_path)
    assert (json.loads(as_data.stdout)["steps"], as_data.stderr) == (2, "")
    quiet = forked(*run, "--quiet", cwd=tmp_path)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    wrong = forked("run", "horizn=1", "--quiet", cwd=tmp_path)
    assert (wrong.returncode, wrong.stdout, wrong.stderr.count("\n")) == (2, "", 1)
    cells = json.loads(forked("report", "tree", "--json", cwd=tmp_path).stdout)["cells"]
    assert [cell["finished"] for cell in cells] == [1]


def test_help_and_tab_list_only_choices_that_the_command_has(tmp_path):
    for command, has, lacks in (
        ("run", "controller", "study"),
        ("figures", "study", "launcher"),
    ):
        listed = (
            forked(command, "--help", cwd=tmp_path)
            .stdout.partition("Choices:")[2]
            .partition("Every setting")[0]
        )
        assert f"\n{has}: " in listed
        assert f"\n{lacks}: " not in listed
        offered = candidates(f"gpmpc {command} ")
        assert f"{has}=" in offered
        assert f"{lacks}=" not in offered


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("gpmpc ", [*COMMANDS]),
        ("gpmpc p", ["plot"]),
        ("gpmpc help rep", ["report"]),
        ("gpmpc run trajectory=l", ["trajectory=lorenz"]),
        ("gpmpc run -m steps=3 controller=conv", ["controller=convex"]),
        ("gpmpc run -m controller=convex,l", ["controller=convex,lqr"]),
        ("gpmpc run controller=nonlin", ["controller=nonlinear"]),
        ("gpmpc run noise.p", ["noise.process="]),
        ("gpmpc run controller=lqr controller.d", []),
        (
            "gpmpc run controller.prediction.d",
            ["controller.prediction.disturbance_gain="],
        ),
        ("gpmpc run folder=tr", ["folder=tree/"]),
        ("gpmpc run --conf", ["--config-name", "--config-dir"]),
        ("gpmpc figures study=h", ["study=horizon"]),
        ("gpmpc plot t", ["tree/"]),
        ("gpmpc plot tree/m", ["tree/my run.mcap"]),
        ("gpmpc plot --format s", ["svg"]),
        ("gpmpc report tree --to t", ["tree/"]),
        ("gpmpc log ", ["info", "recover", "export", "layout", "inspect"]),
        ("gpmpc log info tree/m", ["tree/my run.mcap"]),
        ("gpmpc run 'seed=range(", []),
        ("gpmpc run --nonsense x", []),
        ("gpmpc rnu ", []),
    ],
)
def test_every_word_of_the_line_is_completed(line, offered, tmp_path, monkeypatch):
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "my run.mcap").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", sys.path[:])
    assert candidates(line) == offered


@pytest.mark.parametrize("shell_name", ["bash", "zsh"])
def test_a_shell_completes_at_tab_in_a_terminal(shell_name, tmp_path):
    """A pseudo-terminal: its screen shows what is typed and what TAB adds."""
    if shutil.which(shell_name) is None:
        pytest.skip(f"{shell_name} is not installed")
    (tmp_path / "flights").mkdir()
    quiet = {"bash": ["--norc", "--noprofile"], "zsh": ["-f"]}[shell_name]
    path = os.pathsep.join([os.path.dirname(PATH), os.environ["PATH"]])
    terminal = Terminal(
        [shell_name, *quiet, "-i"],
        tmp_path,
        {"PATH": path, "PS1": "$ ", "TERM": "dumb"},
    )
    try:
        terminal.type(
            f'eval "$(gpmpc completion {shell_name})"; echo re""ady\n', until="ready"
        )
        for typed, completed in (
            ("gpmpc fig", "gpmpc figures "),
            ("gpmpc run traj", "gpmpc run trajectory="),
            ("gpmpc run trajectory=l", "gpmpc run trajectory=lorenz "),
            ("gpmpc run controller.tol", "gpmpc run controller.tolerance="),
            ("gpmpc plot --no", "gpmpc plot --no-animation "),
            ("gpmpc plot fli", "gpmpc plot flights/"),
        ):
            terminal.type(f"{typed}\t", until=completed)
            terminal.type("\x15", until="")  # clears the line
    finally:
        terminal.close()


class Terminal:
    """A program in a pseudo-terminal."""

    def __init__(self, command, cwd, environment):
        self._fd, inner = pty.openpty()
        fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 200, 0, 0))
        self._process = subprocess.Popen(
            command,
            cwd=cwd,
            stdin=inner,
            stdout=inner,
            stderr=inner,
            start_new_session=True,
            env=os.environ | environment,
        )
        os.close(inner)

    def type(self, text, until):
        os.write(self._fd, text.encode())
        shown = ""
        deadline = time.monotonic() + 20
        while until not in shown:
            assert time.monotonic() < deadline, (
                f"{until!r} was not shown after {text!r}: {shown!r}"
            )
            if select.select([self._fd], [], [], 0.1)[0]:
                shown += (
                    os.read(self._fd, 4096).decode(errors="replace").replace("\x07", "")
                )

    def close(self):
        self._process.kill()
        self._process.wait()
        os.close(self._fd)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["completion"], "completion: name a shell: bash, zsh, fish"),
        (["completion", "nosh"], "invalid choice: 'nosh'"),
        (["help", "rnu"], "unknown command 'rnu' (did you mean 'run'?)"),
        (["tables", "-m", "draws=1,2"], "unknown option '-m'"),
        (
            ["run", "-m", "--cfg", "seed=1,2"],
            "--cfg: shows the settings of one run; leave out -m",
        ),
        (
            ["run", "tolerence=1"],
            "(did you mean 'model.tolerance' or 'controller.tolerance'",
        ),
        (
            ["run", "controller.problem.cost.q=1"],
            "(did you mean 'controller.problem.cost.Q'?)",
        ),
        (["run", "--experimental-rerun", "x"], "unknown option '--experimental-rerun'"),
        (
            ["run", "-m", "--config-dir", "nowhere"],
            "--config-dir: nowhere: no such folder",
        ),
        (
            ["run", "-m", "--config-name", "nothing"],
            "Cannot find primary config 'nothing'",
        ),
        (["log", "info", "a.mcap", "b.mcap"], "log info: writes nothing; got b.mcap"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_clear_line(arguments, message, tmp_path):
    done = forked(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("sweep", [[], ["-m"]], ids=["one run", "sweep"])
def test_settings_and_classes_of_the_users_own_folder_are_found(sweep, tmp_path):
    (tmp_path / "own" / "controller").mkdir(parents=True)
    (tmp_path / "own" / "controller" / "mine.yaml").write_text(
        "defaults: [convex]\ntolerance: 0.5\n"
    )
    (tmp_path / "own" / "ours.yaml").write_text("defaults: [run, _self_]\nseed: 5\n")
    (tmp_path / "vehicle.py").write_text(
        "from gpmpc.systems import translational as mine\n"
    )
    own_files = [
        "--config-dir",
        "own",
        "--config-name",
        "ours",
        "controller=mine",
        "system._target_=vehicle.mine",
    ]
    done = forked("run", *sweep, *own_files, *TINY, "folder=tree", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "tree").glob("*/config.yaml")
    for text in ("tolerance: 0.5", "seed: 5", "vehicle.mine"):
        assert text in path.read_text()
    result = json.loads((path.parent / "metrics.json").read_text())
    options = "--config-name ours --config-dir own"
    command = result["provenance"]["command"]
    assert command.startswith(f"gpmpc run {options} controller=mine ")
    assert command.endswith(" folder=tree")
    if not sweep:
        told = forked("run", *own_files, "--help", cwd=tmp_path).stdout
        assert "seed: 5" in told
        assert "controller: compiled, convex" in told
    for plan in (tmp_path / "tree").glob("sweep-*.json"):
        assert json.loads(plan.read_text())["search_options"] == options


def test_kernels_are_compiled_when_asked_for(tmp_path):
    done = forked("warmup", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["seconds"] > 0
    assert "controller=lqr" in done.stderr
    assert not list(tmp_path.iterdir())


PATIENCE = 30  # [s] of a user who pressed Ctrl-C, before pressing it again


@pytest.mark.parametrize(
    ("command", "ended_by", "words_at_the_end"),
    [
        (
            "run -m seed=1,2",
            signal.SIGTERM,
            "terminated; the same command goes on where it stopped",
        ),
        ("run", signal.SIGINT, "interrupted"),
    ],
)
def test_a_signal_in_the_middle_of_flights_is_one_line(
    command, ended_by, words_at_the_end, tmp_path
):
    words = [
        PATH,
        *command.split(),
        *TINY,
        "steps=1000000",
        "recorder=none",
        "folder=tree",
    ]
    flying = subprocess.Popen(
        words,
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + SECONDS
    while not list(tmp_path.glob("tree/*/config.yaml")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(flying.pid, ended_by)
    try:
        _, shown = flying.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:  # the first one may be lost, though rarely
        os.killpg(flying.pid, ended_by)
        _, shown = flying.communicate(timeout=SECONDS)
    assert flying.returncode == 128 + ended_by
    # Remarks on the flight may come before.
    assert shown.endswith(f"\n{words_at_the_end}\n")
    assert "Traceback" not in shown


@pytest.mark.parametrize(
    ("words", "goes_on"),
    [
        (["learn", "flight.csv", "mapping.yaml"], True),
        (["run", "-m", "seed=1,2"], True),
        (["run"], False),
        (["plot", "tree"], False),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_an_interrupted_command_says_whether_it_goes_on(words, goes_on, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(_main, "_call", interrupt)
    monkeypatch.setattr(_main, "_run_with_settings", interrupt)
    with pytest.raises(KeyboardInterrupt) as caught:
        _main._run(words, as_json=False, debug=False)
    advice = "the same command goes on where it stopped"
    assert str(caught.value) == (advice if goes_on else "")


def test_an_error_while_handling_an_interrupt_is_the_interrupt():
    def clean_up_badly():
        try:
            raise KeyboardInterrupt
        finally:
            raise ValueError("clean-up")

    with pytest.raises(ValueError, match="clean-up") as caught:
        clean_up_badly()
    assert _was_interrupted(caught.value)
    assert not _was_interrupted(ValueError("of the settings"))


POOL = """
import os, sys, time
from gpmpc.parallel import in_processes
def job(name):
    open(name, "w").close()
    time.sleep(120)
if __name__ == "__main__":
    list(in_processes(job, ["a", "b", "c"], 2))
"""


@pytest.mark.parametrize(
    "ended_by", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP], ids=str
)
def test_workers_of_a_killed_parent_end_and_release_its_pipe(ended_by, tmp_path):
    (tmp_path / "pool.py").write_text(POOL)
    _kill_and_wait_for_the_pipe([sys.executable, "pool.py"], tmp_path, "b", ended_by)


def test_a_killed_joblib_sweep_leaves_no_worker(tmp_path):
    command = [
        PATH,
        "run",
        "-m",
        *TINY,
        "steps=1000000",
        "seed=1,2",
        "launcher=joblib",
        "hydra.launcher.n_jobs=2",
    ]
    _kill_and_wait_for_the_pipe(
        [*command, "folder=tree"], tmp_path, "tree/*/config.yaml", signal.SIGKILL
    )


def _kill_and_wait_for_the_pipe(command, cwd, begun, ended_by):
    path = os.pathsep.join(filter(None, sys.path))
    parent = subprocess.Popen(
        command,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": path},
        # which nohup sets to be ignored
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + SECONDS
        while not list(cwd.glob(begun)) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert parent.poll() is None
        parent.send_signal(ended_by)
        killed = time.monotonic()
        parent.stdout.read()  # ends when the last process that holds it has ended
        assert time.monotonic() - killed < 20
    finally:
        os.killpg(parent.pid, signal.SIGKILL)
        parent.wait()
        parent.stdout.close()


def test_ctrl_c_in_a_terminal_reaches_no_worker_while_it_starts(tmp_path):
    """Workers that are still importing must print no traceback between other lines."""
    starting = (
        "import os, signal\nif __name__ == '__mp_main__':\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
    )
    (tmp_path / "pool.py").write_text(
        f"{starting}{POOL.replace('time.sleep(120)', 'pass')}"
    )
    done = subprocess.run(
        [sys.executable, "pool.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert {"a", "b", "c"} <= {path.name for path in tmp_path.iterdir()}


def test_log_messages_show_once_and_a_searchs_steps_never(capsys):
    log = logging.getLogger("gpmpc")
    before = log.handlers, log.propagate, log.level
    try:
        logging_console()
        for _ in range(2):
            logging.getLogger("gpmpc.gp._scaling").info("constant columns are centred")
        logging.getLogger("gpmpc.gp._search").info(
            "training: output 1 of 6: evaluation 3"
        )
    finally:
        log.handlers, log.propagate, level = before
        log.setLevel(level)  # which empties what children remember of it
    shown = capsys.readouterr().out
    assert shown.count("constant columns are centred") == 1
    assert "evaluation" not in shown
