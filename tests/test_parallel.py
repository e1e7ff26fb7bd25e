"""Independent jobs in processes: every result with its number, and no orphans."""

import os
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest

from gpmpc.parallel import in_processes


def draw(seed):
    time.sleep(0.2 if seed == 0 else 0)  # the first to start is not the first to finish
    return np.random.default_rng(seed).normal(size=3)


def die(seed):
    if seed == 1:
        os._exit(3)
    return seed


def test_every_result_comes_with_the_number_of_its_job():
    seeds = [0, 3, 1]
    results = dict(in_processes(draw, seeds, 2))
    assert sorted(results) == [0, 1, 2]
    assert all(np.array_equal(results[i], draw(seed)) for i, seed in enumerate(seeds))


def test_a_worker_that_dies_is_one_clear_error():
    with pytest.raises(BrokenProcessPool):
        list(in_processes(die, range(3), 2))


def test_an_interrupt_between_two_starts_ends_the_first_worker(monkeypatch):
    submitted = []
    submit = ProcessPoolExecutor.submit

    def interrupted(pool, *job):
        if submitted:
            raise KeyboardInterrupt
        submitted.append(job)
        return submit(pool, *job)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", interrupted)
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        list(in_processes(time.sleep, [60, 61], 2))
    assert time.perf_counter() - begin < 30


def test_ctrl_c_ends_everything_at_once(tmp_path):
    (tmp_path / "slow_trial.py").write_text(
        "import time\ndef slow(seed):\n"
        "    open(f'begun {seed}', 'w').close()\n    time.sleep(60)\n"
    )
    program = """
        import multiprocessing, os, signal, threading, time
        from glob import glob
        from slow_trial import slow
        from gpmpc.parallel import in_processes
        def interrupt():
            while len(glob("begun *")) < 2:
                time.sleep(0.05)
            os.kill(os.getpid(), signal.SIGINT)
        if __name__ == "__main__":
            threading.Thread(target=interrupt).start()
            try:
                list(in_processes(slow, range(4), 2))
            except KeyboardInterrupt:
                time.sleep(0.2)
                print("interrupted, left:", len(multiprocessing.active_children()))
    """
    (tmp_path / "fly.py").write_text(textwrap.dedent(program))
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "fly.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=50,
    )
    assert done.stdout.strip() == "interrupted, left: 0", done.stderr
    assert done.stderr == ""
    assert time.perf_counter() - begin < 30
