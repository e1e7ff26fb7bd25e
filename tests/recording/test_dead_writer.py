"""A loop that waits for room in the shared memory does not wait for a writer that died meanwhile."""

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

from gpmpc.exceptions import RecordingError
from tests.recording import runs


def test_a_writer_that_dies_while_the_loop_waits_for_it_is_an_error_at_once(tmp_path):
    step = runs.make_step(0, np.random.default_rng(0), horizon=2, variables=150)  # 0.4 MB; the memory holds forty
    recorder = runs.recorder(tmp_path / "run.mcap")
    os.kill(recorder._process.pid, signal.SIGSTOP)
    killer = threading.Timer(1.0, os.kill, (recorder._process.pid, signal.SIGKILL))
    killer.start()
    outcome = []

    def record_too_much():
        try:
            for k in range(120):
                recorder.record(replace(step, k=k, time=0.1 * k))
        except RecordingError as error:
            outcome.append(str(error))

    loop = threading.Thread(target=record_too_much, daemon=True)
    loop.start()
    loop.join(20.0)
    killer.join()
    assert not loop.is_alive()
    assert "unfinished: the process that writes it died" in outcome[0]
    with pytest.raises(RecordingError, match="unfinished"):
        recorder.close()
