from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Reference
from gpmpc.status import Status
from tests.mpc.systems import HOVER, QUADROTOR, quadrotor_gp

CONF = Path(__file__).resolve().parents[2] / "conf"


def names(group):
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def chosen(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        settings = compose("run", overrides=list(overrides))
    return partial(
        instantiate(settings.controller, _convert_="all"), initial_input=HOVER
    )  # the system's otherwise


@pytest.mark.parametrize("controller", names("controller"))
def test_every_controller_of_the_settings_flies(controller):
    make = chosen(f"controller={controller}", "horizon=3")
    mpc = make(QUADROTOR if controller == "nmpc" else quadrotor_gp(20))
    reference = Reference(np.zeros((4, 6)), np.tile(HOVER, (3, 1)))
    assert (
        mpc.control(Gaussian.certain(np.full(6, 0.2)), reference).status
        is Status.SOLVED
    )


def test_all_predictions_hold_the_noise_but_the_papers():
    process_noise = {}
    for name in ("convex", "nonlinear", "state_form", "paper"):
        mpc = chosen(f"controller={name}", "horizon=2")(quadrotor_gp(20))
        process_noise[name] = mpc.prediction.propagator.process_noise
    assert process_noise == dict.fromkeys(process_noise, True) | {"paper": False}


@pytest.mark.parametrize("propagation", names("propagation"))
@pytest.mark.parametrize("solver", names("solver"))
def test_propagation_and_solver_are_chosen_by_name(propagation, solver):
    overrides = [
        f"propagation@controller.propagator={propagation}",
        f"solver@controller.solver={solver}",
    ]
    mpc = chosen("controller=convex", "horizon=2", *overrides)(quadrotor_gp(20))
    reference = Reference(np.zeros((3, 6)))
    assert (
        mpc.control(Gaussian.certain(np.full(6, 0.2)), reference).status
        is Status.SOLVED
    )
