"""Vehicle, reference and plan are drawn where the states say, turned as they say."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from gpmpc.mpc import Decision, Timing
from gpmpc.recording import McapRecorder, RecordedSystem, Step
from gpmpc.status import Status
from gpmpc.systems import Coupled, coupled

H = 3


def spreads(n, rng):
    """Returns covariances (H + 1, n, n): 0.01 I for few states, random for many."""
    roots = 0.1 * (
        np.tile(np.eye(n), (H + 1, 1, 1)) if n < 6 else rng.normal(size=(H + 1, n, n))
    )
    return roots @ roots.mT


def record(path, states, outcomes, rng, **settings):
    """Records a step a second with statuses and failures; returns the steps."""
    n = len(states)
    steps = []
    with McapRecorder(
        path, RecordedSystem(states, ("u",), time_step=1.0, **settings)
    ) as recorder:
        for k, (status, failed) in enumerate(outcomes):
            decision = Decision(
                np.zeros(1),
                np.zeros((H, 1)),
                rng.uniform(-3, 3, (H + 1, n)),
                spreads(n, rng),
                status,
                1,
                Timing(0.0, 0.0, 0.0),
            )
            reference, state = rng.uniform(-3, 3, (2, n))
            step = Step(
                float(k),
                k,
                reference,
                state,
                state,
                np.zeros(1),
                decision,
                np.zeros(n),
                np.eye(n),
                failed=failed,
            )
            recorder.record(step)
            steps.append(step)
    return steps


def decoded(path, topic):
    with path.open("rb") as file:
        messages = make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(topics=[topic])
        return [proto for _, _, _, proto in messages]


def place(vector):
    return [vector.x, vector.y, vector.z]


def turn(quaternion):
    return Rotation.from_quat(
        [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    ).as_matrix()


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    rng = np.random.default_rng(4)
    outcomes = [(Status.SOLVED, False)] * 5 + [
        (Status.INFEASIBLE, True),
        (Status.ITERATION_LIMIT, False),
    ]
    return path, record(path, Coupled.state_names, outcomes, rng, pose=coupled().pose)


def of(state):
    """Returns position and rotation Rz(psi) Ry(theta) Rx(phi) of a whole state."""
    return state[[0, 2, 4]], Rotation.from_euler("ZYX", state[[10, 8, 6]]).as_matrix()


def test_vehicle_reference_and_plan_are_where_states_say(flown):
    path, steps = flown
    for topic, states in (
        ("/pose", [[step.state] for step in steps]),
        ("/reference", [[step.reference] for step in steps]),
        ("/plan/path", [step.decision.means for step in steps]),
    ):
        messages = decoded(path, topic)
        assert len(messages) == len(steps)
        for message, expected in zip(messages, states, strict=True):
            poses = message.poses if topic == "/plan/path" else [message.pose]
            assert message.frame_id == "world"
            for pose, state in zip(poses, expected, strict=True):
                position, rotation = of(state)
                np.testing.assert_allclose(place(pose.position), position)
                np.testing.assert_allclose(turn(pose.orientation), rotation, atol=1e-12)


def test_the_line_of_the_plan_passes_the_predicted_positions(flown):
    path, steps = flown
    for message, step in zip(decoded(path, "/plan/tube"), steps, strict=True):
        [line] = message.entities[0].lines
        np.testing.assert_allclose(
            [place(point) for point in line.points], step.decision.means[:, [0, 2, 4]]
        )


def test_the_tube_has_an_ellipsoid_at_every_stage(flown):
    path, steps = flown
    for message, step in zip(decoded(path, "/plan/tube"), steps, strict=True):
        spheres = message.entities[0].spheres
        np.testing.assert_allclose(
            [place(s.pose.position) for s in spheres], step.decision.means[:, [0, 2, 4]]
        )
        for sphere, covariance in zip(spheres, step.decision.covariances, strict=True):
            directions = turn(sphere.pose.orientation)
            radii = np.array(place(sphere.size)) / 2
            covariance = covariance[np.ix_([0, 2, 4], [0, 2, 4])]
            np.testing.assert_allclose(
                directions @ np.diag(radii**2) @ directions.T,
                4 * covariance,
                atol=1e-12,
            )


def test_the_frames_lead_from_the_display_to_the_vehicle(flown):
    path, steps = flown
    for message, step in zip(decoded(path, "/tf"), steps, strict=True):
        position, rotation = of(step.state)
        assert (message.parent_frame_id, message.child_frame_id) == ("world", "vehicle")
        np.testing.assert_allclose(place(message.translation), position)
        np.testing.assert_allclose(turn(message.rotation), rotation, atol=1e-12)
    for message in decoded(path, "/tf/display"):
        assert (message.parent_frame_id, message.child_frame_id) == ("display", "world")
        np.testing.assert_allclose(
            turn(message.rotation), np.diag([1.0, -1.0, -1.0]), atol=1e-15
        )  # z points down
        assert place(message.translation) == [0, 0, 0]


def test_failed_solves_are_logged_by_how_much_they_mattered(flown):
    path, _ = flown
    failed, limited = decoded(path, "/log")
    assert (failed.level, limited.level) == (failed.ERROR, limited.WARNING)
    assert failed.message.startswith("step 5: INFEASIBLE: ")
    assert (
        limited.message == f"step 6: ITERATION_LIMIT: {Status.ITERATION_LIMIT.advice}"
    )
    policy = "the policy for failures chose the input"
    expected = f"step 5: INFEASIBLE: {Status.INFEASIBLE.advice}; {policy}"
    assert failed.message == expected


def test_an_axis_that_no_state_is_is_zero(tmp_path, rng):
    path = tmp_path / "run.mcap"
    outcomes = [(Status.SOLVED, False)] * 3
    pose = {"x": "x", "z": "z"}
    steps = record(path, ("z", "x", "phi"), outcomes, rng, z_down=False, pose=pose)
    for message, step in zip(decoded(path, "/pose"), steps, strict=True):
        assert place(message.pose.position) == [step.state[1], 0, step.state[0]]
        np.testing.assert_array_equal(turn(message.pose.orientation), np.eye(3))
    for message in decoded(path, "/tf/display"):
        np.testing.assert_array_equal(turn(message.rotation), np.eye(3))
    for message in decoded(path, "/plan/tube"):
        assert len(message.entities[0].spheres) == H + 1
        for sphere in message.entities[0].spheres:  # 0.01 in x and z, nothing in y
            assert sorted(place(sphere.size)) == pytest.approx([0, 0.4, 0.4])
            along = (
                turn(sphere.pose.orientation)
                @ np.diag(place(sphere.size))
                @ turn(sphere.pose.orientation).T
            )
            np.testing.assert_allclose(along, np.diag([0.4, 0, 0.4]), atol=1e-12)
