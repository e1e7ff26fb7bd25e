"""A viewer that connects to the live view receives the steps as they are recorded."""

import base64
import inspect
import json
import os
import select
import socket
import struct
from pathlib import Path

import foxglove
import numpy as np
import pytest

from gpmpc.recording import _schema, read_run
from tests.recording import runs


class Viewer:
    """A WebSocket client with as much of the protocols as these tests need.

    The protocols are RFC 6455 and foxglove.sdk.v1.
    """

    def __init__(self, address, origin=None):
        host, port = address.removeprefix("ws://").split(":")
        self.stream = socket.create_connection((host, int(port)), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            "GET / HTTP/1.1",
            f"Host: {host}:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Protocol: foxglove.sdk.v1",
        ]
        if origin is not None:  # as a browser says which page asks
            lines.append(f"Origin: {origin}")
        self.stream.sendall("\r\n".join([*lines, "\r\n"]).encode())
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += self.stream.recv(1)
        assert answer.startswith(b"HTTP/1.1 101")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stream.close()

    def _read(self, count):
        data = b""
        while len(data) < count:
            data += self.stream.recv(count - len(data))
        return data

    def receive(self):
        """The next message: data from JSON, or bytes."""
        kind, length = self._read(2)
        if length > 125:
            length = struct.unpack(
                *((">H", self._read(2)) if length == 126 else (">Q", self._read(8)))
            )[0]
        content = self._read(length)
        return json.loads(content) if kind & 15 == 1 else content

    def send(self, data):
        content = json.dumps(data).encode()
        head = struct.pack(">BBH", 0x81, 0x80 | 126, len(content)) + bytes(
            4
        )  # a mask of zeros
        self.stream.sendall(head + content)

    def subscribe(self, *topics):
        """Numbers of the subscriptions' topics."""
        channels = {}
        while not set(topics) <= set(channels):
            if (
                isinstance(message := self.receive(), dict)
                and message["op"] == "advertise"
            ):
                channels |= {
                    channel["topic"]: channel for channel in message["channels"]
                }
        subscriptions = [
            {"id": channels[topic]["id"], "channelId": channels[topic]["id"]}
            for topic in topics
        ]
        self.send({"op": "subscribe", "subscriptions": subscriptions})
        return {channels[topic]["id"]: topic for topic in topics}


@pytest.fixture
def recorder(tmp_path):
    recorder = runs.recorder(tmp_path / "run.mcap", live=True)
    yield recorder
    recorder.close()


def test_a_viewer_receives_every_step_at_once(recorder):
    classes = _schema.message_classes(_schema.descriptor(runs.STATES, runs.INPUTS))
    steps = []
    seen = {"/step": [], "/plan/tube": []}
    rng = np.random.default_rng(0)
    with Viewer(recorder.address) as viewer:
        topics = viewer.subscribe(*seen)
        while min(map(len, seen.values())) < 10 and len(steps) < 200:
            steps.append(runs.make_step(len(steps), rng))
            recorder.record(steps[-1])
            while select.select([viewer.stream], [], [], 0.1)[
                0
            ]:  # at first the subscription is on its way
                message = viewer.receive()
                if isinstance(message, bytes) and message[0] == 1:
                    seen[topics[struct.unpack_from("<I", message, 1)[0]]].append(
                        message[13:]
                    )
    received = [classes["Step"].FromString(message) for message in seen["/step"]]
    first = received[0].k
    assert [step.k for step in received] == list(range(first, first + len(received)))
    assert [step.state.vx for step in received] == [
        steps[step.k].state[1] for step in received
    ]
    assert len(seen["/plan/tube"]) >= 10
    recorder.close()
    assert read_run(recorder.path).steps.tolist() == list(range(len(steps)))


def test_a_second_live_view_takes_another_port(recorder, tmp_path):
    with runs.recorder(tmp_path / "other.mcap", live=True) as other:
        assert other.address.startswith("ws://127.0.0.1:")
        assert other.address != recorder.address
        with Viewer(other.address) as viewer:
            viewer.subscribe("/step")


def test_the_live_view_listens_on_this_machine_alone(recorder):
    port = int(recorder.address.rpartition(":")[2])
    for other_address in ("127.0.0.2", "::1"):  # what stands for any other interface
        with pytest.raises(OSError, match=r"refused|unreachable|Cannot assign"):
            socket.create_connection((other_address, port), timeout=2)
    with Viewer(recorder.address) as viewer:
        greeting = viewer.receive()
    assert greeting["op"] == "serverInfo"
    assert greeting["capabilities"] == []  # a viewer sets, publishes and calls nothing


def test_the_library_cannot_tell_pages_apart(recorder):
    """Where this fails, foxglove-sdk has learned to check: let the recorder use it."""
    options = inspect.signature(foxglove.start_server).parameters
    assert not [name for name in options if "origin" in name.lower()]
    with Viewer(recorder.address, origin="https://elsewhere.example") as viewer:
        viewer.subscribe("/step")
    root = Path(__file__).resolve().parents[2]
    for page in ("SECURITY.md", "docs/recording.md"):
        text = " ".join((root / page).read_text().split())
        assert "any page that is open in a browser on the same machine" in text


def test_a_recorder_without_live_view_has_no_address(tmp_path):
    with runs.recorder(tmp_path / "run.mcap") as recorder:
        assert recorder.address is None
