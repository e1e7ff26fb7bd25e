"""A recovered file says so and counts its messages; a finished one's copy does not."""

import numpy as np
import pytest
from mcap.reader import make_reader

from gpmpc.recording import read_run, recover
from tests.recording import runs


def metadata(path):
    with path.open("rb") as file:
        return {
            record.name: record.metadata for record in make_reader(file).iter_metadata()
        }


@pytest.mark.parametrize("cut", [0, 200, 40_000])
def test_a_recovered_file_tells_so_and_counts_what_it_holds(cut, tmp_path):
    path = tmp_path / "run.mcap"
    output = tmp_path / "recovered.mcap"
    steps = runs.record_run(path, steps=20)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - cut])
    recovery = recover(path, output)
    assert recovery.finished == (cut == 0)
    about = metadata(output)
    assert ("recovered" in about) == (cut > 0)
    run = read_run(output)
    if cut:
        assert about["recovered"]["messages"] == str(
            sum(count for count, _ in run.channels.values())
        )
    assert run.steps.tolist() == list(range(len(run.steps)))
    assert (len(run.steps) == len(steps)) == (cut < 1000)
    np.testing.assert_array_equal(recovery.states, run.states)
    assert recovery.path == output
