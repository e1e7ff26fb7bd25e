"""Runs the command as a user does, or in a process that has imported it."""

import io
import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import forkserver
from pathlib import Path
from unittest import mock

import torch

ROOT = Path(__file__).resolve().parents[2]
PATH = str(Path(sys.executable).with_name("gpmpc"))
IMPORTED = [
    "torch",
    "gpytorch",
    "cvxpy",
    "matplotlib.pyplot",
    "gpmpc.cli._main",
    "gpmpc.recording",
]
IMPORTED += [
    "gpmpc.cli._run",
    "gpmpc.cli._sweep",
    "gpmpc.experiments.figures",
    "gpmpc.experiments.tables",
]
IMPORTED += ["gpmpc.studies.report", "gpmpc.studies.flight", "gpmpc.plotting._recorded"]
IMPORTED += ["tests.cli.numba_registries"]
SECONDS = 300  # a command may take
ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)  # what it listens to

_copies = multiprocessing.get_context("forkserver")
_copies.set_forkserver_preload(IMPORTED)


def copied_process(target, args):
    """Returns a process that will be a copy of one that has imported everything."""
    folder = os.getcwd()
    os.chdir(ROOT)  # where the original finds the tests' modules as it starts
    try:
        forkserver.ensure_running()
    finally:
        os.chdir(folder)
    return _copies.Process(target=target, args=args)


def gpmpc(*arguments, cwd, **environment):
    """Runs to its end."""
    return subprocess.run(
        [PATH, *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | environment,
        timeout=SECONDS,
        check=False,
    )


def in_this_process(function, jobs, workers=None):
    """Stands for ``in_processes``, each of which takes seconds to start.

    What goes to a process and comes back is pickled, and torch is as it is there.
    """
    function = pickle.loads(pickle.dumps(function))
    for index, job in enumerate(jobs):
        sent = pickle.loads(pickle.dumps(job))
        dtype = torch.get_default_dtype()
        torch.set_default_dtype(torch.float32)
        try:
            answer = function(sent)
        finally:
            torch.set_default_dtype(dtype)
        yield index, pickle.loads(pickle.dumps(answer))


def forked(*arguments, cwd, trials_here=False, **environment):
    """Runs the command in a copy of a process that has imported everything.

    It is the command's entry point with a process, a folder, arguments and streams of
    its own. The trials of a study are run in it too where ``trials_here`` is true, and
    else in processes that are started for them.
    """
    with tempfile.TemporaryDirectory() as folder:
        streams = [Path(folder) / name for name in ("out", "err")]
        process = copied_process(
            target=_answer,
            args=(arguments, cwd, os.environ | environment, streams, trials_here),
        )
        process.start()
        process.join(SECONDS)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(arguments, SECONDS)
        return subprocess.CompletedProcess(
            arguments, process.exitcode, *(path.read_text() for path in streams)
        )


def begun(*arguments, cwd):
    """Returns a started copy that runs the command and shows nothing."""
    streams = (os.devnull, os.devnull)
    process = copied_process(
        target=_answer, args=(arguments, cwd, {**os.environ}, streams)
    )
    process.start()
    return process


def _answer(arguments, cwd, environment, streams, trials_here=False):
    for path, number in zip(streams, (1, 2), strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    sys.argv = [PATH, *arguments]
    from gpmpc.cli import main

    if trials_here:
        from gpmpc.studies import study

        study.in_processes = in_this_process
    main()  # multiprocessing gives exit codes and tracebacks as any process does


def start(*arguments, cwd):
    """Runs on, in a process group of its own."""
    return subprocess.Popen(
        [PATH, *arguments],
        cwd=cwd,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def called(*arguments, cwd, **environment):
    """Runs the command in this process, which is then as it was.

    For ``--json``, which redirects streams of the process, ask ``forked``.
    """
    from gpmpc.cli import main

    streams = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in ENDS}
    log = logging.getLogger("gpmpc")
    before = log.handlers, log.propagate, log.level
    here = Path.cwd()
    with (
        redirect_stdout(streams[0]),
        redirect_stderr(streams[1]),
        mock.patch.object(sys, "argv", [PATH, *arguments]),
        mock.patch.object(sys, "path", [*sys.path]),
        mock.patch.object(sys, "unraisablehook", sys.unraisablehook),
        mock.patch.dict(os.environ, environment),
    ):
        os.chdir(cwd)
        try:
            main()
            code = 0
        except SystemExit as end:
            code = end.code
        finally:
            os.chdir(here)
            log.handlers, log.propagate, level = before
            log.setLevel(level)  # which empties what children remember of it
            for number, handler in handlers.items():
                signal.signal(number, handler)
    written = [stream.getvalue() for stream in streams]
    return subprocess.CompletedProcess(arguments, code, *written)
