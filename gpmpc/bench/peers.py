"""Problem: how fast is fast? What others would take for the same question, on the same machine, in the same minute.

The quadrotor follows the Lorenz path with the plant in the loop; GPs on 189 transitions of a dithered flight (n = 6,
m = 3), positions and velocities and increments of the inputs weighed by one, bounds of the inputs that bite in half of
the steps. The questions of that flight (state, reference, input before) are put to every contender in turns, and each
starts from its own last answer, shifted where its library lets it. Three kinds are measured, and never divided by
one another:

* ``converged``: to a KKT point of the nonlinear problem on the GPs' mean. All plans are judged by one function
  (``optimality``): contenders stop by measures of their own, which are set to the loosest power of ten that brought the
  plans within ``TOLERANCE`` of it; the share that is within is told.
* ``one program``: one quadratic program a step from the last plan (real-time iteration), ours and with DAQP in it.
* ``linearisation``: one prediction with derivatives, compiled and by automatic differentiation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from itertools import chain
from typing import Any

import numpy as np
import torch

from gpmpc.bench import peer_daqp, peer_do_mpc
from gpmpc.bench.groups import Group
from gpmpc.bench.linearisations import linearisation_groups
from gpmpc.bench.mean_alone import MeanAlone
from gpmpc.bench.optimality import Question, kkt_residual
from gpmpc.bench.peer_casadi import CasadiIpopt
from gpmpc.bench.peer_gpytorch import GPyTorchSlsqp
from gpmpc.bench.quadrotor import HOVER, problem, recorded, trained
from gpmpc.bench.timing import WARM_UP, take_turns
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.mpc.controller import Controller, Decision, Timing
from gpmpc.mpc.convex_mpc import ConvexMPC
from gpmpc.mpc.nonlinear_mpc import NonlinearGPMPC
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Linearization
from gpmpc.status import Status

TRAJECTORY, STEPS = "lorenz", 150
TOLERANCE = 1e-5  # of the common KKT residual
IPOPT, SLSQP, OURS, NEWTON = 1e-6, 1e-12, 1e-6, 1e-8  # tolerances of the contenders' own measures
STD = 0.01  # [m, m/s] of the belief that is propagated in ``linearisation``
FEW = 3  # rounds at least with contenders that take seconds
WARM = ", caches warm"  # of who comes right after its like
NO_TIME = Timing(0.0, 0.0, 0.0)
PATIENCE = 10  # horizon above which those are left out that take minutes

Solve = Callable[[Question, Any], Any]
"""From a question and the last answer (None at first) to an answer, which has ``inputs`` (H, m)."""


class Pilot:
    """A contender that answers the next question with every call, from its own last answer.

    Attributes:
        plans: Number of the question and the plan (H, m), in the order of the calls.
    """

    def __init__(self, solve: Solve, questions: Sequence[Question]):
        self._solve, self._questions, self._last = solve, questions, None
        self.plans: list[tuple[int, np.ndarray]] = []

    def __call__(self) -> None:
        """One answer; after the last question comes the first again, without a last answer."""
        number = len(self.plans) % len(self._questions)
        last = self._last if number else None
        self._last = self._solve(self._questions[number], last)
        self.plans.append((number, self._last.inputs))


def by_controller(controller: Controller) -> Solve:
    """A controller of this package as a contender."""

    def solve(question: Question, last: Decision | None) -> Decision:
        if last is None:
            previous = _begun(question)
        else:  # ``dataclasses.replace`` takes as long as a program
            previous = Decision(
                question.last, last.inputs, last.means, last.covariances, last.status, 0, NO_TIME, None, last.solution
            )
        return controller.control(question.belief, question.reference, previous)

    return solve


def _begun(question: Question) -> Decision:
    """No plan yet, but an input before."""
    H, n = question.targets.shape
    inputs, nothing = np.tile(question.last, (H, 1)), np.full((H + 1, n, n), np.nan)
    return Decision(inputs[0], inputs, nothing[:, 0], nothing, Status.ITERATION_LIMIT, 0, NO_TIME)


def peers_problem() -> TrackingProblem:
    """Weights and bounds of the comparison."""
    return problem(thrust=(6.0, 8.0), tilt=0.05)


def questions_of_a_flight(gp: GPPosterior, problem: TrackingProblem, horizon: int, steps: int) -> list[Question]:
    """What the real-time iteration was asked on a flight with the plant in the loop."""
    flown = recorded(ConvexMPC(gp, Linearization(), problem, horizon, HOVER, covariance="none"), TRAJECTORY, steps)
    before = [np.array(HOVER) if asked.previous is None else asked.previous.input for asked in flown]
    return [Question(asked.belief, asked.reference, last) for asked, last in zip(flown, before, strict=True)]


def converged(gp: GPPosterior, problem: TrackingProblem, horizon: int) -> list[dict[str, Callable[[], Solve] | None]]:
    """Those that solve the nonlinear problem, ours first in each group: how they are made, None where not installed.

    The second group takes seconds a solve.
    """
    asked = (problem, horizon, HOVER)

    def ours() -> Solve:
        settings = {"covariance": "none", "iterations": 50, "tolerance": OURS}
        return by_controller(ConvexMPC(gp, Linearization(), *asked, **settings))

    def nonlinear(optimizer: str) -> Callable[[], Solve]:
        settings = {"optimizer": optimizer, "tolerance": NEWTON}
        return lambda: by_controller(NonlinearGPMPC(gp, MeanAlone(), *asked, **settings))

    def do_mpc() -> Solve:
        return peer_do_mpc.DoMpc(gp, problem, horizon, IPOPT)

    quick = {
        "ConvexMPC, iterated": ours,
        f"ConvexMPC, iterated{WARM}": ours,
        "NonlinearGPMPC, sqp": nonlinear("sqp"),
        "CasADi + IPOPT, exact Hessian": lambda: CasadiIpopt(gp, problem, horizon, "exact", IPOPT),
        "CasADi + IPOPT, Gauss-Newton": lambda: CasadiIpopt(gp, problem, horizon, "gauss-newton", IPOPT),
        "do-mpc + IPOPT": do_mpc if peer_do_mpc.installed() else None,
    }
    slow = {
        "ConvexMPC, iterated": ours,
        "SLSQP, adjoint derivatives": nonlinear("slsqp"),
    }
    if horizon <= PATIENCE:
        slow["SLSQP, GPyTorch + autograd"] = lambda: GPyTorchSlsqp(gp, problem, horizon, SLSQP)
    return [quick, slow]


def one_program(gp: GPPosterior, problem: TrackingProblem, horizon: int) -> list[dict[str, Callable[[], Solve] | None]]:
    """Real-time iterations, ours first in each group; the same controller with DAQP beside it."""
    groups = []
    for name, covariance in (("mean", "none"), ("linearised", "zero_order")):
        asked = (gp, Linearization(), problem, horizon, HOVER, "trajectory", covariance)
        daqp = (lambda a=asked: by_controller(ConvexMPC(*a, peer_daqp.Daqp()))) if peer_daqp.installed() else None
        ours = {f"ConvexMPC, {name}": lambda a=asked: by_controller(ConvexMPC(*a))}
        groups.append(ours | {f"ConvexMPC, {name}, DAQP inside": daqp})
    return groups


KINDS = {"one program": one_program, "converged": converged}  # of which there are two groups each


@dataclass(frozen=True)
class Comparison:
    """How much of a comparison.

    Attributes:
        horizons: H.
        seconds: Processor time of each group of contenders [s]; those that take seconds a solve take three calls' time.

    Raises:
        SettingError: A number out of range, or no horizon.
    """

    horizons: Sequence[int] = (1, 10, 20)
    seconds: float = 10.0

    def __post_init__(self) -> None:
        if not isinstance(self.horizons, list | tuple) or not self.horizons:
            raise SettingError("horizons", f"must be a list with something in it; got {self.horizons!r}")
        for horizon in self.horizons:
            check_number("horizons", horizon, least=1, whole=True)
        check_number("seconds", self.seconds, above=0, unit="[s]")

    def groups(self) -> list[Group]:
        """Of contenders: two of either kind at every horizon, and the linearisations.

        A group's record is its rows. A row has ``part``, ``kind``, ``what``, ``H`` (None for ``linearisation``), the
        summary of its ``Times`` [ms], and ``ratio``, the median over ours of the same turns. Plans have the common
        residual, ``kkt`` (median) and ``kkt_worst``; converged ones ``tolerance``, and ``within``, the share of them
        that is. Where ours is there twice, the first comes after a contender that has emptied the caches, the second
        right after the first, and ``ratio_warm`` is the one over that. What is not installed has a ``note`` instead of
        all that.
        """
        task, model = peers_problem(), cache(lambda: trained(TRAJECTORY))
        asked = lru_cache(maxsize=1)(lambda horizon: questions_of_a_flight(model(), task, horizon, STEPS))

        def measured(horizon: int, kind: str, number: int) -> list[dict]:
            group = KINDS[kind](model(), task, horizon)[number]
            patience = self.seconds, FEW if kind == "converged" and number else 2 * FEW
            return _measured(kind, group, model(), task, horizon, asked(horizon), patience)

        found = [
            Group(f"H={horizon} {kind} {number + 1} of 2", partial(measured, horizon, kind, number))
            for horizon in dict.fromkeys(self.horizons)
            for kind in KINDS
            for number in range(2)
        ]
        last = self.horizons[-1]
        return [*found, Group("linearisations", lambda: _linearisations(model(), asked(last), self.seconds))]

    def rows(self, records: Sequence[list[dict]]) -> list[dict]:
        """Those of every group that is measured."""
        return list(chain.from_iterable(records))


def _linearisations(gp: GPPosterior, questions: Sequence[Question], seconds: float) -> list[dict]:
    """The rows of one prediction with derivatives, in the middle of a flight."""
    at = Gaussian(questions[len(questions) // 2].belief.mean, STD**2 * torch.eye(gp.state_dim, dtype=torch.float64))
    rows = []
    for group in linearisation_groups(gp, at, torch.tensor(HOVER, dtype=torch.float64), reverse_mode=True):
        times = take_turns(group, seconds, least=FEW)
        ours = next(iter(times.values()))
        common = {"part": "peers", "kind": "linearisation", "H": None}
        rows += [common | {"what": name, **t.summary(), "ratio": t.over(ours)} for name, t in times.items()]
    return rows


def _measured(
    kind: str,
    group: Mapping[str, Callable[[], Solve] | None],
    gp: GPPosterior,
    task: TrackingProblem,
    horizon: int,
    questions: Sequence[Question],
    patience: tuple[float, int],
) -> list[dict]:
    """The rows of one group that takes turns, for a time and a number of rounds."""
    pilots = {}
    for name, make in group.items():
        if make is not None:
            pilots[name] = Pilot(make(), questions)
    times = take_turns(pilots, patience[0], least=patience[1])
    ours, rows = next(iter(times.values())), []
    warm = next((taken for name, taken in times.items() if name.endswith(WARM)), None)
    for name in group:
        row = {"part": "peers", "kind": kind, "what": name, "H": horizon}
        if name not in times:
            rows.append(row | {"note": peer_do_mpc.MISSING})
            continue
        plans = pilots[name].plans[WARM_UP:]
        residuals = np.array([kkt_residual(gp, task, questions[number], plan) for number, plan in plans])
        row |= {"kkt": float(np.median(residuals)), "kkt_worst": float(residuals.max())}
        if kind == "converged":
            row |= {"tolerance": TOLERANCE, "within": float((residuals <= TOLERANCE).mean())}
        row |= times[name].summary() | {"ratio": times[name].over(ours)}
        if warm is not None:
            row["ratio_warm"] = times[name].over(warm)
        rows.append(row)
    return rows
