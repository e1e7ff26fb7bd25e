"""A recorded run is a table: each column is the field of its name, in order."""

import numpy as np
import pytest

from gpmpc.recording import read_run
from gpmpc.status import Status
from tests.recording import runs


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    rng = np.random.default_rng(3)
    outcomes = [
        (Status.SOLVED, False),
        (Status.INFEASIBLE, True),
        (Status.TIME_LIMIT, False),
        (Status.SOLVED, False),
    ]
    steps = [
        runs.make_step(k, rng, status=status, failed=failed)
        for k, (status, failed) in enumerate(outcomes)
    ]
    with runs.recorder(path) as recorder:
        for step in steps:
            recorder.record(step)
    return read_run(path), steps


def test_every_column_is_what_its_name_says(flown):
    run, steps = flown
    expected = {"time": [step.time for step in steps], "k": [0, 1, 2, 3]}
    for group in ("reference", "state", "measured", "input", "innovation"):
        for i, name in enumerate(runs.INPUTS if group == "input" else runs.STATES):
            expected[f"{group}.{name}"] = [getattr(step, group)[i] for step in steps]
    for i, name in enumerate(runs.STATES):
        expected[f"belief_std.{name}"] = [
            np.sqrt(step.belief_covariance[i, i]) for step in steps
        ]
    expected |= {
        "iterations": [step.decision.iterations for step in steps],
        "active_set_size": [
            np.count_nonzero(step.decision.solution.active_set) for step in steps
        ],
        "timing.model": [0.001] * 4,
        "timing.build": [0.002] * 4,
        "timing.solve": [0.003] * 4,
        "timing.total": [0.006] * 4,
        "gp_size": [step.gp_size for step in steps],
        "gp_version": [step.gp_version for step in steps],
        "novelty": [step.decision.novelty for step in steps],
    }
    for i, name in enumerate(("primal", "dual", "gap")):
        expected[f"residuals.{name}"] = [
            step.decision.solution.residuals()[i] for step in steps
        ]
    for name, values in expected.items():
        np.testing.assert_allclose(
            run.columns[name], values, rtol=1e-14, atol=1e-15, err_msg=name
        )
    assert run.columns["status"].tolist() == [
        "SOLVED",
        "INFEASIBLE",
        "TIME_LIMIT",
        "SOLVED",
    ]
    assert run.columns["failed"].tolist() == [False, True, False, False]
    verdicts = {"status", "failed", "judgement", "reason"}
    assert set(run.columns) == {*expected, *verdicts}


def test_a_data_frame_holds_the_columns_and_their_units(flown):
    run, _ = flown
    frame = pytest.importorskip("pandas") and run.to_pandas()
    assert list(frame.columns) == list(run.columns)
    assert len(frame) == 4
    assert frame.attrs["units"]["state.vx"] == "m/s"
