"""Another implementation of MCAP finds in a recording all that this one wrote.

It is in another language, and needs Node with the packages @mcap/core and fzstd,
anywhere: ``NODE_PATH`` names their folder (see CONTRIBUTING.md).
"""

import base64
import json
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from gpmpc.recording import recover
from gpmpc.status import Status
from tests.recording import runs

SCRIPT = Path(__file__).with_name("read_mcap.js")
STEPS = 30


def _node_reads_mcap():
    node, code = shutil.which("node"), "require('@mcap/core'); require('fzstd')"
    return (
        bool(node)
        and subprocess.run(
            [node, "-e", code], capture_output=True, check=False
        ).returncode
        == 0
    )


pytestmark = pytest.mark.skipif(
    not _node_reads_mcap(),
    reason="node does not find @mcap/core and fzstd; CONTRIBUTING.md says how",
)


@pytest.fixture(scope="module", params=["finished", "recovered"])
def path(request, tmp_path_factory):
    """A file that was closed, and one that was cut in the middle and recovered."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    rng = np.random.default_rng(0)
    with runs.recorder(path) as recorder:
        for k in range(STEPS):
            status = Status.INFEASIBLE if k == 7 else Status.SOLVED
            recorder.record(runs.make_step(k, rng, status=status, failed=k == 7))
    if request.param == "finished":
        return path
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    recover(path, path.with_name("recovered.mcap"))
    return path.with_name("recovered.mcap")


def ours(path):
    """What Python's reader finds."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        summary = reader.get_summary()
        return {
            "channels": {
                channel.topic: [
                    summary.schemas[channel.schema_id].name,
                    summary.schemas[channel.schema_id].encoding,
                    channel.message_encoding,
                ]
                for channel in summary.channels.values()
            },
            "counts": Counter(channel.topic for _, channel, _ in messages),
            "metadata": {
                record.name: dict(record.metadata) for record in reader.iter_metadata()
            },
            "attachments": [
                [a.name, a.media_type, base64.b64encode(a.data).decode()]
                for a in reader.iter_attachments()
            ],
            "statistics": len(messages),
            "done": True,
        }


@pytest.mark.parametrize("way", ["stream", "indexed"])
def test_another_reader_finds_everything(path, way):
    output = subprocess.run(
        ["node", str(SCRIPT), str(path)], capture_output=True, text=True, check=False
    )
    assert output.returncode == 0, output.stderr
    read = json.loads(output.stdout)[way]
    expected = ours(path)
    assert read == expected
    topics = {
        "/step",
        "/plan",
        "/qp",
        "/pose",
        "/reference",
        "/plan/path",
        "/plan/tube",
        "/tf",
        "/tf/display",
        "/log",
    }
    assert set(read["channels"]) == topics
    assert {"run", "units", "frames"} <= set(read["metadata"])
    assert [name for name, *_ in read["attachments"]] == ["config.yaml"]
    if path.name == "run.mcap":
        assert read["counts"] == dict.fromkeys(topics, STEPS) | {"/log": 1}
        assert read["metadata"]["end"] == {"steps": str(STEPS), "outcome": "complete"}
    else:
        assert 0 < read["counts"]["/step"] < STEPS
