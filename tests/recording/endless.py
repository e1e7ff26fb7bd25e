"""Forks a process for every path that it reads, which records there until it is killed; says its number.

A fork needs no start of the interpreter, so that many can be killed. A second word is a number of steps to stop after.
"""

import os
import signal
import sys
from types import SimpleNamespace

import numpy as np

from gpmpc.recording import McapRecorder, RecordedSystem, Step
from gpmpc.status import Status

n, m, H = 6, 3, 10


def record(path, steps):
    rng = np.random.default_rng(0)
    system = RecordedSystem(["x", "vx", "y", "vy", "z", "vz"], ["U1", "ux", "uy"], time_step=0.01)
    recorder = McapRecorder(path, system, config="seed: 7\n", metadata={"seed": 7})
    for k in range(steps):
        decision = SimpleNamespace(
            inputs=rng.standard_normal((H, m)),
            means=rng.standard_normal((H + 1, n)),
            covariances=np.tile(np.eye(n), (H + 1, 1, 1)),
            status=Status.SOLVED,
            iterations=3,
            timing=SimpleNamespace(model=0.0, build=0.0, solve=0.0),
            problem=None,
            solution=None,
        )
        vectors = [rng.standard_normal(n) for _ in range(3)]
        recorder.record(Step(k * 0.01, k, *vectors, decision.inputs[0], decision, vectors[0], np.eye(n)))
    print("recorded", flush=True)
    signal.pause()


for line in sys.stdin:
    path, *steps = line.split()
    if (child := os.fork()) == 0:
        record(path, int(steps[0]) if steps else 10**9)
    print(child, flush=True)
