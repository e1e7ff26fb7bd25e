import subprocess
import sys
import textwrap
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.simulation import trials


def draw(seed):
    time.sleep(0.2 if seed == 0 else 0)  # the first to start is not the first to finish
    if seed == 5:
        raise ValueError("unlucky")
    return np.random.default_rng(seed).normal(size=3)


def die(seed):
    import os

    if seed == 1:
        os._exit(3)
    return seed


def test_parallel_is_serial_in_the_order_of_the_seeds_and_a_failure_stops_no_other():
    parallel, serial = (trials(draw, [5, 0, 3, 1], workers=w, progress=False) for w in (2, 1))
    assert [trial.name for trial in parallel] == ["seed 5", "seed 0", "seed 3", "seed 1"]
    for ours, theirs in zip(parallel, serial, strict=True):
        assert (ours.seed, ours.error) == (theirs.seed, theirs.error)
        assert np.array_equal(ours.result, theirs.result) or ours.error
    assert parallel[0].error == "ValueError: unlucky"
    assert parallel[0].result is None


def test_one_bar_counts_the_trials(capsys):
    trials(draw, 2, workers=1, label="hovering")
    assert "hovering" in (shown := capsys.readouterr().out)
    assert "2/2" in shown


def test_a_worker_that_dies_is_one_clear_error():
    with pytest.raises(GpmpcError, match="a worker process died .* unfinished: .*seed 1"):
        trials(die, 3, workers=2, progress=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seeds": 0}, "seeds: must be a whole number, 1 or more; got 0"),
        ({"seeds": []}, "must be one or more different whole numbers"),
        ({"seeds": [1, 1]}, r"different whole numbers; got \[1, 1\]"),
        ({"seeds": [-1]}, "seeds: must be a whole number, 0 or more; got -1"),
        ({"seeds": 2, "workers": 0}, "workers: must be a whole number, 1 or more; got 0"),
    ],
)
def test_misuse_is_refused_before_the_first_trial(arguments, message):
    with pytest.raises(SettingError, match=message):
        trials(draw, progress=False, **arguments)


def test_an_interrupt_between_the_starts_of_two_workers_ends_the_first(monkeypatch):
    submitted, submit = [], ProcessPoolExecutor.submit

    def interrupted(pool, *job):
        if submitted:
            raise KeyboardInterrupt
        submitted.append(job)
        return submit(pool, *job)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", interrupted)
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        trials(time.sleep, [60, 61], workers=2, progress=False)
    assert time.perf_counter() - begin < 30


def test_ctrl_c_ends_everything_at_once(tmp_path):
    (tmp_path / "slow_trial.py").write_text("import time\ndef slow(seed):\n    time.sleep(60)\n")
    program = """
        import multiprocessing, os, signal, threading, time
        from slow_trial import slow
        from gpmpc.simulation import trials
        if __name__ == "__main__":
            threading.Timer(3.0, os.kill, [os.getpid(), signal.SIGINT]).start()
            try:
                trials(slow, 4, workers=2, progress=False)
            except KeyboardInterrupt:
                time.sleep(0.2)
                print("interrupted, left:", len(multiprocessing.active_children()))
    """
    (tmp_path / "fly.py").write_text(textwrap.dedent(program))
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "fly.py"], cwd=tmp_path, capture_output=True, text=True, timeout=50)
    assert done.stdout.strip() == "interrupted, left: 0", done.stderr
    assert done.stderr == ""
    assert time.perf_counter() - begin < 30
