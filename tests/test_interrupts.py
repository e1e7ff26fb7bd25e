"""A Ctrl-C that CasADi would keep reaches the command after the solve that it met."""

import os
import signal
import threading

import numpy as np
import pytest
import torch

from gpmpc._interrupts import interrupts_after
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Problem, Reference, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.systems import System, Translational


def swallow():
    """What a library does that goes on in its own way."""
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        return False
    return True


def test_an_interrupt_waits_for_the_end_of_the_block():
    went_on = False
    with pytest.raises(KeyboardInterrupt), interrupts_after():
        went_on = swallow()
    assert went_on
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_one_does_not_wait():
    with pytest.raises(KeyboardInterrupt), interrupts_after():
        assert [swallow(), swallow()] == [True, False]


def test_nothing_happens_without_an_interrupt_or_in_a_thread():
    with interrupts_after():
        pass
    done = []

    def other():
        with interrupts_after():
            done.append(True)

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert done == [True]


def test_an_error_inside_is_that_error():
    with pytest.raises(ZeroDivisionError), interrupts_after():
        1 / 0  # noqa: B018
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_nmpc_passes_an_interrupt_on_after_the_solve():
    plant = System(Translational(), time_step=1.0, substeps=1)
    controller = NMPC(
        plant,
        Problem(Tracking([1.0] * 6, [1.0] * 3, penalized="inputs")),
        5,
        [7.26, 0.0, 0.0],
    )
    solver = controller._program.solver
    statuses = []

    class InterruptedSolver:
        """Solves until the signal has come, which is in the middle of a solve."""

        def __call__(self, **arguments):
            sent = threading.Event()
            timer = threading.Timer(
                0.05, lambda: (os.kill(os.getpid(), signal.SIGINT), sent.set())
            )
            timer.start()
            while not sent.is_set():
                solution = solver(**arguments)
                statuses.append(solver.stats()["return_status"])
            timer.join()
            return solution

        def stats(self):
            return solver.stats()

    controller._program = controller._program._replace(solver=InterruptedSolver())
    with pytest.raises(KeyboardInterrupt):
        controller.control(
            Gaussian.certain(torch.zeros(6)), Reference(np.full((6, 6), 0.5))
        )
    assert set(statuses) == {"Solve_Succeeded"}
