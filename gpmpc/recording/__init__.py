"""Recordings of runs in MCAP files: writing, live view, reading, replaying, recovering.

``McapRecorder`` records the steps of a flight, ``read_run`` reads a file as a ``Run``,
``replay`` solves the program of a recorded step again, and ``recover`` writes what is
whole of a damaged file to a new one.

How a step is written: ``_recorder`` copies it, ``_encoding`` makes messages of it
(``_schema``), ``_scene`` draws it, and ``_sink`` writes the file. How a file is read:
``_read_run`` takes its bytes apart (``_frames``, ``_index``), finds what is whole
behind damage (``_records``, ``_chunk_search``), sorts it (``_content``), and decodes it
(``_decoding``) to a ``Run`` (``_run``).

To record one more number of a step, add

1. the number to ``gpmpc.step.Step``, unless its decision has it, and where it is known
   to ``Flight.add`` in ``gpmpc.simulation._flight``,
2. a field with a new number to ``message Step`` in ``_schema.PROTO``,
3. its value to ``Encoder._step_message`` in ``_encoding``,
4. its unit to ``RecordedSystem.field_units`` in ``_system``, unless it is a ``State``,
   an ``Input`` or a ``Timing``, whose units are there, and to docs/recording.md,
5. an attribute to ``Run``, with its column in ``Run.columns``, in ``_run``,
6. the line that reads it to ``_make_run`` in ``_read_run``.

To record one more topic, add a message to ``_schema.PROTO`` and its topic to
``TOPICS``, take its class in ``Encoder.__init__`` and yield it in ``Encoder.encode``,
read it in ``_decoding.decode_messages`` to a field of ``DecodedMessages``, and hand
that to ``Run`` in ``_read_run._make_run``. Files without the field or topic are still
read: protobuf gives zeros, and no messages.
"""

from gpmpc.recording._bags import bag_flaws
from gpmpc.recording._flaws import NO_CHECKSUMS, Flaw
from gpmpc.recording._layout import layout
from gpmpc.recording._read_run import read_run
from gpmpc.recording._recorder import McapRecorder
from gpmpc.recording._recovery import recover
from gpmpc.recording._run import Run, replay
from gpmpc.recording._system import RecordedSystem
from gpmpc.step import Step

__all__ = [
    "NO_CHECKSUMS",
    "Flaw",
    "McapRecorder",
    "RecordedSystem",
    "Run",
    "Step",
    "bag_flaws",
    "layout",
    "read_run",
    "recover",
    "replay",
]
