"""Figures of a recording show what was recorded, and nothing of what is lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.figure import Figure

from gpmpc.exceptions import DataError, SettingError
from gpmpc.plotting import animate, inputs_figure, timing_figure, tracking_figure
from gpmpc.recording import McapRecorder, RecordedSystem, read_run
from tests.cli.command import called
from tests.recording.runs import record_run

STEPS = 8
FIGURES = (tracking_figure, inputs_figure, timing_figure)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "run.mcap"
    record_run(path, STEPS)
    return read_run(path)


@pytest.fixture
def with_gap(run):
    """The steps 0 to 3 and 6 and 7, of which 2 was not applied."""
    rows = np.array([0, 1, 2, 3, 6, 7])
    per_step = ("steps", "times", "references", "states", "inputs", "timings")
    per_step += ("plan_means", "plan_covariances", "failed", "judgements")
    parts = {name: getattr(run, name)[rows] for name in per_step}
    parts["failed"] = parts["steps"] == 2
    return replace(run, **parts)


def lines_of(axis, label):
    return [line for line in axis.lines if line.get_label() == label]


def test_a_prediction_is_of_one_step_and_of_a_plan_that_flew(with_gap):
    figure = tracking_figure(with_gap)
    error_axis = figure.axes[2 * len(figure.axes) // 3]
    (error,) = error_axis.lines[:1]
    means = with_gap.plan_means[:, 1, 0]
    states = with_gap.states[:, 0]
    shown = dict(zip(error.get_xdata(), error.get_ydata(), strict=True))
    predicted = [
        row for row, time in enumerate(with_gap.times) if shown[time] == shown[time]
    ]
    # Not the first, the one behind step 2, and the one behind the lost steps.
    assert predicted == [1, 2, 5]
    for row in predicted:
        assert shown[with_gap.times[row]] == states[row] - means[row - 1]


def test_a_tube_says_which_noise_it_holds(with_gap):
    deviations = " ".join(["0.1"] * len(with_gap.state_names))
    for about, words in (
        ({"noise_std": deviations}, "the model's noise included"),
        ({}, "as planned"),
    ):
        figure = tracking_figure(replace(with_gap, metadata={"run": about}))
        collections = [each for axis in figure.axes for each in axis.collections]
        assert any(str(each.get_label()).endswith(words) for each in collections)


def test_nothing_is_drawn_across_lost_steps(with_gap):
    times = with_gap.times
    for figure, label in (
        (tracking_figure(with_gap), "flown"),
        (tracking_figure(with_gap), "reference"),
        (inputs_figure(with_gap), "applied"),
    ):
        (line,) = lines_of(figure.axes[0], label)
        assert np.isnan(line.get_ydata()[4])
        assert np.isfinite(np.delete(line.get_ydata(), 4)).all()
    # An input holds until its own step ends: .1 s behind the last before the gap.
    assert line.get_xdata()[4] == pytest.approx(times[3] + 0.1)
    assert line.get_xdata()[-1] == pytest.approx(times[-1] + 0.1)
    stages = timing_figure(with_gap).axes[0].patches
    assert all(np.isnan(stage.get_data().values[4]) for stage in stages)


def test_a_run_without_steps_is_refused_in_a_line(run, tmp_path):
    path = tmp_path / "empty.mcap"
    system = RecordedSystem(run.state_names, run.input_names, time_step=0.1)
    McapRecorder(path, system).close()
    empty = read_run(path)
    for draw in FIGURES:
        with pytest.raises(DataError, match=r"empty\.mcap: holds no step"):
            draw(empty)
    with pytest.raises(DataError, match="holds no step"):
        animate(empty, tmp_path / "flight.gif")


def test_a_command_with_dollars_is_no_formula(run):
    command = r"gpmpc run folder=$HOME/a_{b note=$\frac"
    metadata = run.metadata | {"run": {"command": command}}
    for draw in FIGURES:
        figure = draw(replace(run, metadata=metadata))
        assert figure.get_suptitle() == command.replace("$", r"\$")
    figure.set_layout_engine("none")
    figure.draw_without_rendering()


def test_a_film_as_mp4_needs_ffmpeg(run, tmp_path, monkeypatch):
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(SettingError, match="an MP4 needs ffmpeg"):
        animate(run, tmp_path / "flight.mp4")
    assert not (tmp_path / "flight.mp4").exists()
    with pytest.raises(SettingError, match=r"path: must end in \.gif or \.mp4; got"):
        animate(run, tmp_path / "flight.MOV")


def bands_of(figure):
    """The outlines of all that is filled in a figure."""
    areas = [area for axis in figure.axes for area in axis.collections]
    return [path.vertices for area in areas for path in area.get_paths()]


def test_a_noise_that_is_no_numbers_widens_no_band(run):
    words = " ".join("abcdef")
    hostile = replace(run, metadata=run.metadata | {"run": {"noise_std": words}})
    bands = [bands_of(tracking_figure(each)) for each in (hostile, run)]
    assert len(bands[0]) > 0
    np.testing.assert_array_equal(*bands)


def killed(picture, file=None, **settings):
    """Writes half of a picture."""
    if file is None:
        Path(picture.outfile).write_bytes(b"half of it")
    else:
        file.write(b"half of it")
    raise KeyboardInterrupt


def test_a_figure_is_whole_or_as_it_was(tmp_path, monkeypatch):
    record_run(tmp_path / "run.mcap", steps=1)
    (tmp_path / "tracking.png").write_bytes(b"old")
    monkeypatch.setattr(Figure, "savefig", killed)
    with pytest.raises(KeyboardInterrupt):
        called("plot", "run.mcap", "--to", ".", "--no-animation", cwd=tmp_path)
    assert (tmp_path / "tracking.png").read_bytes() == b"old"
    assert not [*tmp_path.glob(".*.partial")]


def test_an_animation_is_whole_or_as_it_was(tmp_path, monkeypatch):
    record_run(tmp_path / "run.mcap", steps=1)
    (tmp_path / "flight.gif").write_bytes(b"old")
    monkeypatch.setattr(PillowWriter, "finish", killed)
    with pytest.raises(KeyboardInterrupt):
        animate(read_run(tmp_path / "run.mcap"), tmp_path / "flight.gif")
    assert (tmp_path / "flight.gif").read_bytes() == b"old"


def test_figures_of_a_tree_lie_below_it_whatever_fails(tmp_path, monkeypatch):
    """However many runs there are; one run's own folder is no tree."""

    def save(figure, file, **settings):
        if Path(file.name).parent.name == "bad":
            raise ValueError("a colour that nobody knows")
        file.write(b"drawn")

    monkeypatch.setattr(Figure, "savefig", save)
    drawn = tmp_path / "to" / "good" / "tracking.png"
    for name, code in (("good", 0), ("bad", 1)):
        record_run(tmp_path / "tree" / name / "run.mcap", steps=1)
        done = called("plot", "tree", "--to", "to", "--no-animation", cwd=tmp_path)
        assert done.returncode == code
        assert drawn.read_bytes() == b"drawn"
        drawn.unlink()
    assert "ValueError: a colour that nobody knows" in done.stderr
    assert not (tmp_path / "to" / "bad" / "tracking.png").exists()
    called("plot", "tree/good", "--to", "to", "--no-animation", cwd=tmp_path)
    assert (tmp_path / "to" / "tracking.png").read_bytes() == b"drawn"
    assert not drawn.exists()
