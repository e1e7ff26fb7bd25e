"""A recording, its log and its figures say how every step was judged."""

from dataclasses import replace

import numpy as np
import pytest
from foxglove.messages import LogLevel
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gpmpc.exceptions import RecordingError
from gpmpc.mpc import Judgement
from gpmpc.plotting import inputs_figure, tracking_figure
from gpmpc.recording import McapRecorder, RecordedSystem, _recorder, read_run
from tests.recording import runs

ODD = Judgement("suspicious", "odd")
GONE = Judgement("lost", "gone")
TOLD = [None, Judgement(), ODD, ODD, GONE, Judgement()]


def record(path, judgements=TOLD):
    rng = np.random.default_rng(0)
    system = RecordedSystem(runs.STATES, runs.INPUTS, time_step=runs.TIME_STEP)
    with McapRecorder(path, system) as recorder:
        for k, judgement in enumerate(judgements):
            step = replace(runs.make_step(k, rng, qp=False), judgement=judgement)
            recorder.record(step)
    return read_run(path)


@pytest.fixture
def run(tmp_path):
    return record(tmp_path / "run.mcap")


def test_judgements_are_read_as_they_were_made(run):
    levels = ["", "healthy", "suspicious", "suspicious", "lost", "healthy"]
    assert run.judgements.tolist() == levels
    assert run.reasons.tolist() == ["", "", "odd", "odd", "gone", ""]
    assert run.columns["judgement"].tolist() == levels


def test_the_log_says_when_a_flight_is_judged_otherwise(run):
    with run.path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        said = [
            (message.message, message.level)
            for _, _, _, message in reader.iter_decoded_messages(topics=["/log"])
        ]
    warning, error, info = said
    assert warning[0] == "from step 2 on suspicious: odd"
    assert error[0] == "from step 4 on lost: gone"
    assert info[0] == "from step 5 on healthy"
    assert info[1] < warning[1] < error[1]


def test_figures_shade_what_was_suspicious_or_lost(run):
    for figure in (tracking_figure(run), inputs_figure(run)):
        shaded = {
            patch.get_label(): patch.get_extents() for patch in figure.axes[0].patches
        }
        assert shaded.keys() == {"suspicious", "lost"}
        assert shaded["suspicious"].width == pytest.approx(2 * shaded["lost"].width)


def test_a_level_that_nobody_knows_is_damage(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    monkeypatch.setitem(_recorder._LOG_LEVELS, "fine", LogLevel.Info)
    with pytest.raises(RecordingError, match="judgement 'fine' is unknown"):
        record(path, [Judgement("fine", "")])
