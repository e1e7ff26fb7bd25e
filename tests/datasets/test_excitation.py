from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from gpmpc.datasets import Excitation, ExcitedData
from gpmpc.exceptions import SettingError
from gpmpc.systems import pendulum, rotational, step, translational
from gpmpc.trajectories import Elliptical

OUTER = Excitation(
    [1] * 6, [1] * 3, [7.26, 0, 0], dither=[0.3, 0.03, 0.03], noise=[0.01] * 6
)
INNER = Excitation(
    [1] * 6, [1] * 3, [0, 0, 0], dither=[0.05] * 3, noise=[1e-4, 1e-3] * 3
)
DATA = ExcitedData(OUTER, INNER, samples=60)
CONF = Path(__file__).resolve().parents[2] / "conf"
POSITION = translational()
ATTITUDE = rotational(substeps=1)


def by_input(plant, x, u):
    """The true derivatives by the inputs (6, 3)."""
    return np.array(
        [
            (step(plant, x, u + e) - step(plant, x, u - e)) / 2e-6
            for e in 1e-6 * np.eye(3)
        ]
    ).T


@pytest.mark.parametrize(("system", "flown"), [(POSITION, OUTER), (ATTITUDE, INNER)])
def test_transitions_hold_the_noise_and_inputs_that_acted(system, flown):
    data = DATA.transitions(system, Elliptical())
    stepped = [
        step(system, x, u)
        for x, u in zip(data.states.numpy(), data.inputs.numpy(), strict=True)
    ]
    left = data.next_states.numpy() - stepped
    assert np.abs(left.std(axis=0) / flown.noise - 1).max() < 0.5
    assert (data.inputs.numpy().std(axis=0) > 0.7 * np.array(flown.dither)).all()
    assert np.array_equal(data.states[1:].numpy(), data.next_states[:-1].numpy())


def test_the_seed_decides_the_flight():
    first, again, other = (
        replace(DATA, seed=seed).transitions(ATTITUDE, Elliptical()).states.numpy()
        for seed in (0, 0, 1)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_model_learns_the_inputs_effect_only_with_dither():
    def error(dither):
        source = replace(DATA, translational=replace(OUTER, dither=dither))
        data = source.transitions(POSITION, Elliptical())
        features = np.hstack([data.features.numpy(), np.ones((60, 1))])
        learned = np.linalg.lstsq(features, data.next_states.numpy(), rcond=None)[0].T[
            :, 6:9
        ]  # near hover it is linear
        true = by_input(POSITION, np.zeros(6), np.array([0.74 * 9.81, 0, 0]))
        return np.linalg.norm(learned - true) / np.linalg.norm(true)

    assert error(OUTER.dither) < 0.1
    assert error([0, 0, 0]) > 0.4


def test_a_frozen_attitude_can_be_flown():
    source = replace(
        DATA, samples=20, translational=replace(OUTER, initial_input=[14.5, 0, 0])
    )
    data = source.transitions(
        translational(frozen_attitude=(np.pi / 4, np.pi / 4)), Elliptical()
    )
    assert abs(float(data.inputs[:, 0].mean()) - 2 * 0.74 * 9.81) < 0.5


def test_the_settings_that_ship_are_these():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("tables", ["data=excited", "data.samples=60"])
    shipped = instantiate(config.data, _convert_="all")
    assert isinstance(shipped, ExcitedData)
    ours = shipped.transitions(ATTITUDE, Elliptical())
    assert np.array_equal(ours.states, DATA.transitions(ATTITUDE, Elliptical()).states)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "data.samples: must be a whole number, 1 or more; got 0"),
        ({"hold": 1.5}, "data.hold: must be a whole number, 1 or more; got 1.5"),
        ({"seed": -1}, "data.seed: must be a whole number, 0 or more; got -1"),
        (
            {"response_time": 0},
            r"data.response_time: must be a number above 0 \[s\]; got 0",
        ),
        (
            {"attitude": "level"},
            "data.attitude: must be one of paper, exact; got 'level'",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(change, message):
    with pytest.raises(SettingError, match=message):
        replace(DATA, **change)
    with pytest.raises(
        SettingError, match="dither: must be a number, 0 or more; got -1"
    ):
        replace(OUTER, dither=[-1, 0, 0])
    with pytest.raises(
        SettingError,
        match="are of translational and rotational alone; data=random is of any system",
    ):
        DATA.transitions(pendulum(), Elliptical())
    with pytest.raises(
        SettingError, match="trajectory: these data follow one; got none"
    ):
        DATA.transitions(POSITION, None)
