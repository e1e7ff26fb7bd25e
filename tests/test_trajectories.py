import numpy as np
import pytest

from gpmpc.exceptions import SettingError
from gpmpc.trajectories import Elliptical, Hover, Lorenz, Step, Waypoints, states_along

WAYPOINTS = Waypoints([0.0, 3.0, 10.0], [[0, 0, 0], [1, -2, 3], [1, 5, -4]])
ALL = [Elliptical(), Lorenz(), Step(at=3.3), Hover([1, 2, 3]), WAYPOINTS]


@pytest.mark.parametrize("trajectory", ALL, ids=lambda t: type(t).__name__)
def test_positions_and_velocities_follow_the_shape_of_the_times(trajectory):
    times = np.linspace(0.1, 9, 6).reshape(2, 3)
    for quantity in (trajectory(times), trajectory.velocity(times)):
        assert quantity.shape == (2, 3, 3)
        assert np.isfinite(quantity).all()
    assert np.array_equal(trajectory(times)[1, 2], trajectory(times[1, 2]))


@pytest.mark.parametrize("trajectory", ALL, ids=lambda t: type(t).__name__)
def test_the_velocity_is_the_derivative_of_the_position(trajectory):
    times = np.array(
        [0.37, 1.63, 4.41, 7.77]
    )  # off the samples of Lorenz, off the jump, off the waypoints
    step = 1e-6
    numeric = (trajectory(times + step) - trajectory(times - step)) / (2 * step)
    scale = 1 + np.abs(numeric).max()
    # Lorenz: the dense output of an integration at tolerance 1e-3 obeys the equation to
    # about that.
    assert (
        np.abs(trajectory.velocity(times) - numeric).max()
        < (2e-3 if isinstance(trajectory, Lorenz) else 1e-7) * scale
    )


def test_the_elliptical_trajectory_is_the_papers():
    j = np.arange(50.0)
    expected = np.column_stack(
        [15 * np.sin(0.1 * j), 15 * np.cos(0.1 * j), -5 - 0.25 * j]
    )
    assert np.allclose(Elliptical()(j), expected, atol=1e-13)


def test_lorenz_is_sampled_four_times_an_accepted_step():
    times = Lorenz()._samples
    spacing = np.diff(times)[:188].reshape(-1, 4)
    assert np.allclose(
        spacing, spacing[:, :1], rtol=1e-9
    )  # four equal parts of each step
    assert len(np.unique(spacing[:, 0].round(9))) > 20  # and the steps adapt
    assert (
        0.008 < spacing.min() < spacing.max() < 0.035
    )  # the authors' data: 0.011 to 0.028
    path = Lorenz()(np.arange(189.0))
    assert np.abs(path[:, 0]).max() < 14
    assert path[:, 2].min() > 5


def test_a_lorenz_trajectory_starts_where_it_is_told():
    start = (1.0, 2.0, 20.0)
    assert np.allclose(Lorenz(start=start, scale=(1, 1, 1))(np.zeros(1))[0], start)


def test_lorenz_outside_its_duration_is_refused():
    with pytest.raises(SettingError, match="defined from 0 to 20"):
        Lorenz(duration=20.0)(np.array([21.0]))


def test_waypoints_are_passed_never_overshot_and_held_outside():
    for time, position in zip(WAYPOINTS.times, WAYPOINTS.positions, strict=True):
        assert np.allclose(WAYPOINTS(np.array(time)), position)
    assert np.allclose(
        WAYPOINTS(np.array([-5.0, 99.0])),
        [WAYPOINTS.positions[0], WAYPOINTS.positions[-1]],
    )
    path = WAYPOINTS(np.linspace(0, 10, 500))
    assert path[:, 0].max() <= 1 + 1e-12
    assert not WAYPOINTS.velocity(np.array([-1.0, 11.0])).any()


def test_a_step_jumps_at_its_time():
    step = Step(before=[0, 0, 0], after=[1, 2, 3], at=2.0)
    assert np.array_equal(step(np.array([1.999, 2.0])), [[0, 0, 0], [1, 2, 3]])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: Hover([]),
            "position: a position is a list of finite numbers, one per tracked state",
        ),
        (lambda: Hover([1, 2, np.nan]), "list of finite numbers"),
        (lambda: Step(after=[1]), "before, after: a position"),
        (lambda: Waypoints([0, 1], [[0, 0, 0]]), "got 2 times, 1 positions"),
        (
            lambda: Waypoints([0, 0], [[0, 0, 0], [1, 1, 1]]),
            r"strictly increasing \[s\]; got \[0, 0\]",
        ),
        (
            lambda: states_along(Hover([1, 2]), np.zeros(4)),
            r"trajectory: must have positions \(..., 3\), x, y and z; got 2 entries",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(build, message):
    with pytest.raises(SettingError, match=message):
        build()


def test_the_default_lorenz_is_the_papers_with_one_axis_turned():
    """(0.7 X, -0.7 Y, Z) from (-1.79, -3.13, 12.74), Cao, Lai and Alam (2017), (27)."""
    assert np.allclose(
        Lorenz()(np.array(0.0)), [0.7 * -1.79, -0.7 * -3.13, 12.74], rtol=1e-14
    )


@pytest.mark.parametrize("samples", [1, 2, 4])
def test_lorenz_passes_the_ends_of_the_accepted_steps(samples):
    """Of K samples a step every K-th is its end: the same points of one integration."""
    ends = Lorenz(samples_per_step=samples, duration=40.0)(samples * np.arange(10.0))
    assert np.allclose(
        ends, Lorenz(samples_per_step=4, duration=40.0)(4.0 * np.arange(10)), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("samples_per_step", 0),
        ("samples_per_step", 1.5),
        ("relative_tolerance", 0.0),
        ("sampling_time", -1.0),
        ("duration", 0.0),
        ("sigma", np.nan),
        ("rho", "a"),
        ("beta", np.inf),
        ("start", (1.0, 2.0)),
        ("scale", (1, 2)),
    ],
)
def test_a_senseless_setting_of_lorenz_is_refused_by_name(setting, value):
    with pytest.raises(SettingError, match=setting):
        Lorenz(**{setting: value})


@pytest.mark.parametrize("time", [-0.1, 20.1, np.nan])
def test_lorenz_is_defined_from_start_to_duration_inclusive(time):
    trajectory = Lorenz(duration=20.0)
    assert np.isfinite(trajectory(np.array([0.0, 20.0]))).all()
    for call in (trajectory, trajectory.velocity):
        with pytest.raises(
            SettingError,
            match="duration: this Lorenz trajectory is defined from 0 to 20 s",
        ):
            call(np.array([1.0, time]))
