"""Takes gymnasium environments as systems, and offers systems as environments.

An environment moves on by itself: it is stepped from where it stands, and set to
another state only where it can be (a MuJoCo environment whose observation is qpos,
qvel). Where it ends an episode, a flight is lost. Needs ``gpmpc[sim]``.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gpmpc import systems
from gpmpc._angles import state_difference
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.systems._simulators import Simulator, library
from gpmpc.systems._system import System, step

Array = np.ndarray
OURS = (
    "acrobot",
    "cart_pole",
    "double_integrator",
    "double_pendulum",
    "pendulum",
    "planar_quadrotor",
    "stirred_tank",
    "translational",
)


class _Environment(Simulator):
    """The dynamics of a gymnasium environment.

    Args:
        environment: The environment, or its name.
        observe: From an observation to the state (n,); None for the observation itself.
        state_names: Of the state; without any, x1, x2, ...
        input_names: Of the action; without any, u1, u2, ...
        make_settings: Further arguments of ``gymnasium.make``.
    """

    def __init__(
        self,
        environment: Any,
        observe: Callable[[Any], Array] | None,
        state_names: Sequence[str],
        input_names: Sequence[str],
        make_settings: dict[str, Any],
    ):
        if isinstance(environment, str):
            environment = _make(environment, make_settings)
        self.environment = environment
        self._observe = observe
        action_space = environment.action_space
        _check_space("action", action_space, remedy="")
        if observe is None:
            _check_space(
                "observation",
                environment.observation_space,
                remedy="; name a function with observe",
            )
        lowest = action_space.low.astype(float)
        highest = action_space.high.astype(float)
        self.input_limits = (lowest, highest)
        n = len(self.reset(0))
        m = len(lowest)
        self.state_names = tuple(state_names or [f"x{i + 1}" for i in range(n)])
        self.input_names = tuple(input_names or [f"u{i + 1}" for i in range(m)])
        if len(self.state_names) != n or len(self.input_names) != m:
            raise ShapeError(
                f"state_names and input_names must be {n} and {m} names; "
                f"got {len(self.state_names)} and {len(self.input_names)}"
            )

    def _reset(self, seed: int) -> Array:
        return self._state(self.environment.reset(seed=seed)[0])

    def _step(self, input: Array) -> tuple[Array, bool]:
        action = np.clip(input, *self.input_limits).astype(
            self.environment.action_space.dtype
        )
        observation, _, terminated, truncated, _ = self.environment.step(action)
        return self._state(observation), bool(terminated or truncated)

    def _set(self, state: Array) -> bool:
        """Sets a MuJoCo environment to a state, where it shows all of it.

        Some show velocities up to a limit: what they showed is then another state.
        """
        inner = self.environment.unwrapped
        model: Any = getattr(inner, "model", None)
        data: Any = getattr(inner, "data", None)
        if (
            self._observe is not None
            or not hasattr(inner, "set_state")
            or model is None
            or data is None
            or len(state) != model.nq + model.nv
        ):
            return False
        physics = np.concatenate([data.qpos, data.qvel])
        if self._now is None or not np.array_equal(physics, self._now):
            return False
        inner.set_state(state[: model.nq], state[model.nq :])
        return True

    def _state(self, observation: Any) -> Array:
        if self._observe is not None:
            observation = self._observe(observation)
        state = np.array(observation, dtype=float)
        if state.ndim != 1:
            raise ShapeError(f"observe must give a state (n,); got {state.shape}")
        return state


def _make(name: str, make_settings: dict[str, Any]) -> Any:
    """Makes an environment without a limit of its steps.

    Raises:
        SettingError: There is no such environment, or it does not take the settings.
    """
    gymnasium = library("gymnasium")
    defaults = {"max_episode_steps": -1, "disable_env_checker": True}
    try:
        return gymnasium.make(name, **(defaults | make_settings))
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise SettingError("environment", f"{name!r}: {reason}") from error


def _check_space(kind: str, space: Any, remedy: str) -> None:
    """Raises ``SettingError`` unless a space is a box of one dimension."""
    box = library("gymnasium").spaces.Box
    if not isinstance(space, box) or len(space.shape) != 1:
        raise SettingError(
            "environment",
            f"the {kind} space must be a Box of one dimension; got {space}{remedy}",
        )


def gymnasium_system(
    environment: Any,
    observe: Callable[[Any], Array] | None = None,
    state_names: Sequence[str] = (),
    input_names: Sequence[str] = (),
    time_step: float | None = None,
    make: dict[str, Any] | None = None,
    **settings: Any,
) -> System:
    """Makes a system of a gymnasium environment.

    Args:
        environment: Its name, such as ``"InvertedPendulum-v5"``, or one that was made.
        observe: From an observation to the state (n,); the observation itself by
            default.
        state_names: Of the state; x1, x2, ... by default.
        input_names: Of the action; u1, u2, ... by default.
        time_step: [s]; by default the environment's ``dt``.
        make: Further arguments of ``gymnasium.make``.
        settings: Of ``System``, such as ``units``, ``tracked`` and ``goal``; the
            environment limits the inputs.

    Raises:
        SettingError: There is no such environment, its spaces are not boxes of one
            dimension, or it gives no time step.
        ShapeError: Names do not fit it.
    """
    dynamics = _Environment(environment, observe, state_names, input_names, make or {})
    if time_step is None:
        time_step = getattr(dynamics.environment.unwrapped, "dt", None)
    if time_step is None:
        raise SettingError("time_step", "is not known of this environment; say it [s]")
    lower, upper = dynamics.input_limits
    defaults = {
        "name": str(environment),
        "input_lower": lower,
        "input_upper": upper,
    }
    return System(dynamics, float(time_step), 1, **(defaults | settings))


def make_environment(system: System | str, **settings: Any) -> Any:
    """Makes a gymnasium environment of a system.

    The system may be one of this package's, by name and settings. The observation is
    the state. The reward is minus the squared distance of the tracked states from the
    goal, summed over their units; an episode ends where those of one unit are farther
    from it than at the start, and than ``System.lost``. A simulator starts where it
    starts by itself, and ends where it ends.

    Raises:
        SettingError: There are settings beside a system that was made.
    """
    gymnasium = library("gymnasium")
    if settings and not isinstance(system, str):
        named = ", ".join(settings)
        raise SettingError(
            "system", f"must be a name where settings are given; got {named} beside one"
        )
    flown: System = (
        getattr(systems, system)(**settings) if isinstance(system, str) else system
    )

    class Environment(gymnasium.Env):  # type: ignore[name-defined]
        """A system as an environment."""

        metadata: Any = {"render_modes": []}  # noqa: RUF012

        def __init__(self) -> None:
            n = len(flown.state_names)
            lower = np.array(flown.input_lower)
            upper = np.array(flown.input_upper)
            self.observation_space = gymnasium.spaces.Box(
                -np.inf, np.inf, (n,), np.float64
            )
            self.action_space = gymnasium.spaces.Box(lower, upper, dtype=np.float64)
            self.state = np.array(flown.goal)

        def reset(
            self, *, seed: int | None = None, options: Any = None
        ) -> tuple[Array, dict]:
            """Starts where the system starts, or from its region."""
            super().reset(seed=seed)
            self.state = np.array(flown.start or flown.goal, dtype=float)
            if flown.stateful:
                drawn_seed = int(self.np_random.integers(2**31))
                self.state = flown.dynamics.reset(drawn_seed)
            elif flown.start is None and flown.region is not None:
                lower, upper = flown.region
                self.state = self.np_random.uniform(lower, upper)
            self._limits = {
                unit: max(flown.lost_from(unit), 1.001 * distance)
                for unit, distance in self._distances().items()
            }
            return self.state.copy(), {}

        def step(self, action: Array) -> tuple[Array, float, bool, bool, dict]:
            """Takes one step; the action is clipped."""
            action = np.clip(
                np.asarray(action, dtype=float), flown.input_lower, flown.input_upper
            )
            with np.errstate(over="ignore", invalid="ignore"):
                self.state = step(flown, self.state, action)
            distances = self._distances()
            reward = -sum(distance**2 for distance in distances.values())
            terminated = not all(
                distance <= self._limits[unit] for unit, distance in distances.items()
            )
            if flown.stateful:
                terminated = terminated or flown.dynamics.ended
            return self.state.copy(), reward, terminated, False, {}

        def _distances(self) -> dict[str, float]:
            """Returns how far the tracked states of each unit are from the goal."""
            errors = state_difference(self.state, flown.goal, flown.angle_indices)
            return {
                unit: float(np.linalg.norm(errors[places]))
                for unit, places in flown.tracked_by_unit.items()
            }

    return Environment()


def register_environments() -> list[str]:
    """Registers this package's systems as gymnasium environments.

    Returns:
        Their names, such as ``gpmpc/cart_pole-v0``.
    """
    gymnasium = library("gymnasium")
    names = [f"gpmpc/{name}-v0" for name in OURS]
    for name, system in zip(names, OURS, strict=True):
        if name not in gymnasium.registry:
            entry = f"{__name__}:make_environment"
            gymnasium.register(
                name,
                entry_point=entry,
                max_episode_steps=500,
                kwargs={"system": system},
            )
    return names
