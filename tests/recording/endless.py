"""Records until it is killed. Loads no torch and no compiler, so that it can be started and killed often."""

import sys
from types import SimpleNamespace

import numpy as np

from gpmpc.recording import McapRecorder, Step
from gpmpc.status import Status

n, m, H = 6, 3, 10
rng = np.random.default_rng(0)
names = ["x", "vx", "y", "vy", "z", "vz"]
about = {"config": "seed: 7\n", "metadata": {"seed": 7}}
recorder = McapRecorder(sys.argv[1], names, ["U1", "ux", "uy"], time_step=0.01, **about)
print(recorder._process.pid, flush=True)
k = 0
while True:
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
    k += 1
    if len(sys.argv) > 2 and k == int(sys.argv[2]):
        print("recorded", flush=True)
        sys.stdin.read()
