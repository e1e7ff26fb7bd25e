"""Recordings of runs in MCAP files: writing, reading, replaying, recovering; the only importer of mcap and protobuf."""

from gpmpc.recording.layout import layout
from gpmpc.recording.reader import RecordedProblem, Run, read_run, replay
from gpmpc.recording.recorder import McapRecorder
from gpmpc.recording.recovery import Recovery, recover
from gpmpc.step import Step

__all__ = ["McapRecorder", "RecordedProblem", "Recovery", "Run", "Step", "layout", "read_run", "recover", "replay"]
