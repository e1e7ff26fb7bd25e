import numpy as np
import pytest

from gpmpc.datasets import NMPCData, PaperData, Tracking
from gpmpc.exceptions import DataError, SettingError
from gpmpc.systems import (
    Map,
    Rotational,
    System,
    Translational,
    attitude_for_thrust_direction,
    pendulum,
    rotational,
    step,
    translational,
)
from gpmpc.trajectories import Elliptical, Hover, Lorenz

SYSTEMS = {"translational": translational(), "rotational": rotational()}
TRANSLATIONAL = System(Map(Translational(frozen_attitude=(np.pi / 4, np.pi / 4))), 1.0)
NMPC_DATA = NMPCData(
    Tracking(TRANSLATIONAL, [21000, 1, 27000, 1, 21000, 1], [1, 1, 1], [7.26, 0, 0]),
    Tracking(
        System(Map(Rotational()), 1.0),
        [27000, 1, 21000, 1, 51000, 1],
        [1.3, 1.5, 1.1],
        [0, 0, 0],
    ),
)


@pytest.fixture(scope="module")
def elliptical():
    return {
        system.name: NMPC_DATA.transitions(system, Elliptical())
        for system in SYSTEMS.values()
    }


def test_transitions_obey_the_plant_and_follow_each_other(elliptical):
    for part, plant in (
        ("translational", TRANSLATIONAL),
        ("rotational", System(Map(Rotational()), 1.0)),
    ):
        data = elliptical[part]
        assert len(data) == 189
        stepped = [
            step(plant, x, u)
            for x, u in zip(data.states.numpy(), data.inputs.numpy(), strict=True)
        ]
        assert np.array_equal(np.array(stepped), data.next_states.numpy())
        assert np.array_equal(data.states[1:].numpy(), data.next_states[:-1].numpy())


def test_the_velocity_reaches_the_reference_two_samples_ahead(elliptical):
    reached = elliptical["translational"].next_states[:, 1::2].numpy()
    assert (
        np.abs(reached - Elliptical()(np.arange(2.0, 191.0))).max() < 0.1
    )  # what the input weights leave


def test_rotational_data_steer_to_attitudes_two_samples_ahead(elliptical):
    u = elliptical["translational"].inputs[2:, 1:].numpy()
    attitudes = attitude_for_thrust_direction(u[:, 0], u[:, 1], convention="paper")
    assert (
        np.abs(
            elliptical["rotational"].next_states[:-2, [1, 3]].numpy() - attitudes
        ).max()
        < 5e-5
    )
    assert (
        np.abs(elliptical["rotational"].next_states[:, [4, 5]].numpy()).max() < 1e-9
    )  # yaw stays at rest


def test_the_same_flight_twice_is_the_same_to_the_bit(elliptical):
    again = NMPC_DATA.transitions(SYSTEMS["translational"], Elliptical())
    assert np.array_equal(
        again.inputs.numpy(), elliptical["translational"].inputs.numpy()
    )


def test_lorenz_is_tracked_from_rest():
    data = NMPC_DATA.transitions(SYSTEMS["translational"], Lorenz())
    assert (
        np.abs(
            data.next_states[:, 1::2].numpy() - Lorenz()(np.arange(2.0, 191.0))
        ).max()
        < 0.01
    )


def test_our_flight_is_the_authors_elliptical_one(paper_data, elliptical):
    source = PaperData(paper_data)
    for part, columns, tolerance in (
        ("translational", range(15), 1e-5),
        ("rotational", [0, 1, 2, 3, 6, 7, 9, 10, 11, 12], 1e-4),
    ):
        theirs = source.transitions(SYSTEMS[part], Elliptical(), "elliptical")
        ours = elliptical[part]
        theirs, ours = (
            np.hstack([d.features.numpy(), d.next_states.numpy()])[:, list(columns)]
            for d in (theirs, ours)
        )
        assert (
            np.abs(ours - theirs).max(axis=0) < tolerance * np.ptp(theirs, axis=0)
        ).all()


def test_an_unknown_subsystem_is_refused(tmp_path):
    for source in (NMPC_DATA, PaperData(tmp_path)):
        with pytest.raises(
            SettingError, match="these data are of translational and rotational alone"
        ):
            source.transitions(pendulum(), Elliptical(), "elliptical")


def test_the_authors_files_are_asked_for_by_name(tmp_path):
    with pytest.raises(DataError, match="no such folder; data.folder must hold"):
        PaperData(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"ds_nmpc_Lorenz_rotate\.txt: no such file"):
        PaperData(tmp_path).transitions(SYSTEMS["rotational"], Lorenz(), "lorenz")
    (tmp_path / "ds_nmpc_Lorenz_rotate.txt").write_text("0 " * 15 + "\n")
    with pytest.raises(
        DataError, match="the file holds 1 rows; data.samples asks for 189"
    ):
        PaperData(tmp_path).transitions(SYSTEMS["rotational"], Lorenz(), "lorenz")


@pytest.mark.parametrize("samples", [0, -1, 1.5, None, "abc", True])
def test_the_authors_samples_are_a_positive_whole_number(samples, tmp_path):
    with pytest.raises(
        SettingError, match="data.samples: must be a whole number, 1 or more"
    ):
        PaperData(tmp_path, samples=samples)


def test_an_integrated_plant_can_be_flown():
    gentle = Tracking(
        System(Translational(), time_step=0.5, substeps=1),
        [1, 1, 1, 1, 1, 1],
        [0.1, 10, 10],
        [7.26, 0, 0],
    )
    flown = NMPCData(gentle, NMPC_DATA.rotational, samples=20, horizon=8)
    data = flown.transitions(SYSTEMS["translational"], Hover([1.0, -1.0, 2.0]))
    assert np.abs(data.next_states[-1, ::2].numpy() - [1, -1, 2]).max() < 0.2


def test_no_samples_are_refused():
    with pytest.raises(
        SettingError, match="data.samples: must be a whole number, 1 or more; got 0"
    ):
        NMPCData(NMPC_DATA.translational, NMPC_DATA.rotational, samples=0)


@pytest.mark.parametrize("horizon", [0, -1, 1.5, None])
def test_a_horizon_is_a_positive_whole_number(horizon):
    with pytest.raises(
        SettingError, match="data.horizon: must be a whole number, 1 or more"
    ):
        NMPCData(NMPC_DATA.translational, NMPC_DATA.rotational, horizon=horizon)
