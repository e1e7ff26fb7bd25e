"""Forks a process for every path that it reads, and says its number.

The process records there until it is killed. A fork needs no start of the interpreter,
so that many can be killed. A second word is a number of steps to stop after.
"""

import os
import signal
import sys

import numpy as np

from gpmpc.mpc import Decision, Timing
from gpmpc.recording import McapRecorder, RecordedSystem, Step
from gpmpc.status import Status

n = 6
m = 3
H = 10


def record(path, steps):
    rng = np.random.default_rng(0)
    system = RecordedSystem(
        ["x", "vx", "y", "vy", "z", "vz"], ["U1", "ux", "uy"], time_step=0.01
    )
    recorder = McapRecorder(path, system, config="seed: 7\n", metadata={"seed": 7})
    for k in range(steps):
        inputs = rng.standard_normal((H, m))
        means = rng.standard_normal((H + 1, n))
        covariances = np.tile(np.eye(n), (H + 1, 1, 1))
        decision = Decision(
            inputs[0],
            inputs,
            means,
            covariances,
            Status.SOLVED,
            3,
            Timing(0.0, 0.0, 0.0),
        )
        vectors = [rng.standard_normal(n) for _ in range(3)]
        recorder.record(
            Step(
                k * 0.01,
                k,
                *vectors,
                decision.inputs[0],
                decision,
                vectors[0],
                np.eye(n),
            )
        )
    print("recorded", flush=True)
    signal.pause()


for line in sys.stdin:
    path, *steps = line.split()
    if (child := os.fork()) == 0:
        record(path, int(steps[0]) if steps else 10**9)
    print(child, flush=True)
