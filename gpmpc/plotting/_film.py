"""Films a recorded flight of a MuJoCo model, rendered without a screen."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, UnsupportedModel
from gpmpc.plotting._animation import check_file, save_animation
from gpmpc.plotting._style import (
    FLOWN,
    PLAN,
    REFERENCE,
    broken,
    check_run,
    gaps_of,
)

if TYPE_CHECKING:
    from gpmpc.recording import Run
    from gpmpc.systems import System

Array = np.ndarray

# Size of MuJoCo's off-screen buffer, in pixels.
_WIDTH = 640
_HEIGHT = 480
_MOST_SHAPES = 2000  # of a scene
_FEWEST_REFERENCES = 300  # drawn of a longer path, and less than twice as many
_TRAIL = 200  # steps of the flown path that are drawn
_LEGEND = (("reference", REFERENCE), ("flown", FLOWN), ("plan and its tube", PLAN))


class _JointDynamics(Protocol):
    """Dynamics whose states say where the joints of a MuJoCo model are."""

    model: Any

    def positions(self, state: Array, /) -> Array: ...


@explains_arguments
def film(
    run: "Run",
    system: "System",
    path: str | Path,
    frames: int = 100,
    enlarged: float = 1.0,
) -> None:
    """Writes a flight as MuJoCo renders it, as a GIF or an MP4 by the file's ending.

    Reference, plan and tube are drawn where the recording's ``pose`` has x, y and z.

    Args:
        run: A recording.
        system: The system that flew: its ``dynamics`` have a MuJoCo ``model``, and
            ``positions`` from a state (n,) to those of the model's joints (nq,), as a
            system of joints has.
        path: The file, .gif or .mp4 (which needs ffmpeg).
        frames: Largest number of frames; steps are left out evenly.
        enlarged: Factor of the tube's 2-sigma ellipsoids.

    Raises:
        SettingError: There is no off-screen rendering here, or no ffmpeg for an MP4.
        DataError: No step was recorded.
        UnsupportedModel: The system is none of MuJoCo whose state says where its joints
            are.
    """
    check_run(run)
    check_file(path)
    dynamics = system.dynamics
    shows_joints = hasattr(dynamics, "model") and hasattr(dynamics, "positions")
    if not shows_joints:
        raise UnsupportedModel(
            f"{run.path}: a film needs steps of a MuJoCo model, "
            "and its joints' positions"
        )
    with _off_screen() as mujoco:
        scene = _Scene(mujoco, run, dynamics, enlarged)
        picture = _FilmPicture(scene, run.times)
        save_animation(picture.figure, picture.draw, len(run.times), path, frames)
        scene.free()


@contextmanager
def _off_screen() -> Iterator[ModuleType]:
    """Lends MuJoCo's module while it can render without a screen.

    Raises:
        SettingError: It cannot here.
    """
    try:
        mujoco = import_module("mujoco")
        is_chosen = "MUJOCO_GL" in os.environ or "DISPLAY" in os.environ
        library = import_module("mujoco.gl_context" if is_chosen else "mujoco.egl")
        context = library.GLContext(_WIDTH, _HEIGHT)
        context.make_current()
    except Exception as error:  # of ctypes, of PyOpenGL, of a driver
        raise SettingError(
            "film",
            "no off-screen rendering by MuJoCo here; gpmpc.plotting.animate draws "
            f"flights without it ({error})",
        ) from error
    try:
        yield mujoco
    finally:
        context.free()


class _FilmPicture:
    """A figure that is filled by the rendered scene, with the time and a legend."""

    def __init__(self, scene: "_Scene", times: Array):
        self._scene = scene
        self._times = times
        self.figure = Figure(figsize=(_WIDTH / 80, _HEIGHT / 80))
        self.figure.set_layout_engine("none")  # the picture fills it
        FigureCanvasAgg(self.figure)
        axis = self.figure.add_axes((0, 0, 1, 1))
        self._image = axis.imshow(scene.render(0), aspect="auto")
        axis.set_axis_off()
        self._clock = self.figure.text(0.02, 0.95, "")
        if scene.axes:
            self._add_legend()

    def _add_legend(self) -> None:
        for i, (name, colour) in enumerate(_LEGEND):
            height = 0.02 + 0.04 * i
            self.figure.text(0.02, height, name, color=colour, weight="bold")

    def draw(self, k: int) -> None:
        """Draws step k."""
        self._image.set_data(self._scene.render(k))
        self._clock.set_text(f"{self._times[k]:.2f} s")


class _Scene:
    """The scene of a flight, rendered step by step.

    Args:
        mujoco: The module, with a current context of rendering.
        run: The flight.
        dynamics: The model that flew.
        enlarged: Factor of the tube's 2-sigma ellipsoids.
    """

    def __init__(
        self,
        mujoco: ModuleType,
        run: "Run",
        dynamics: _JointDynamics,
        enlarged: float,
    ):
        self._mujoco = mujoco
        self._run = run
        self._dynamics = dynamics
        self._enlarged = enlarged
        self._data = mujoco.MjData(dynamics.model)
        self._scene = mujoco.MjvScene(dynamics.model, _MOST_SHAPES)
        self._rendering = mujoco.MjrContext(
            dynamics.model, mujoco.mjtFontScale.mjFONTSCALE_100
        )
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._rendering)
        # Indices of the states that are the position in space; empty where there are
        # none.
        self.axes: list[int] = []
        if {"x", "y", "z"} <= run.pose.keys():
            self.axes = [run.pose[axis] for axis in "xyz"]
        self._gaps = gaps_of(run)
        stride = max(1, len(run.times) // _FEWEST_REFERENCES)
        self._reference_path = run.references[::stride][:, self.axes]

    def free(self) -> None:
        """Frees what MuJoCo has of the scene on the graphics card."""
        self._rendering.free()

    def render(self, k: int) -> Array:
        """Returns the picture (height, width, 3) of step k.

        A camera follows a vehicle that has a position.
        """
        mujoco = self._mujoco
        model = self._dynamics.model
        self._data.qpos[:] = self._dynamics.positions(self._run.states[k])
        mujoco.mj_forward(model, self._data)
        mujoco.mjv_updateScene(
            model,
            self._data,
            mujoco.MjvOption(),
            None,
            self._camera(k),
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        if self.axes:
            self._add_paths(k)
            self._add_tube(k)
        return self._pixels()

    def _camera(self, k: int) -> Any:
        """Returns a camera at the vehicle; MuJoCo's own without a position."""
        camera = self._mujoco.MjvCamera()
        self._mujoco.mjv_defaultFreeCamera(self._dynamics.model, camera)
        if self.axes:
            camera.lookat[:] = self._run.states[k, self.axes]
            camera.distance = 2.2
            camera.elevation = -25
            camera.azimuth = 120
        return camera

    def _pixels(self) -> Array:
        """Returns the rendered scene (height, width, 3), the upper row first."""
        view = self._mujoco.MjrRect(0, 0, _WIDTH, _HEIGHT)
        pixels = np.empty((_HEIGHT, _WIDTH, 3), dtype=np.uint8)
        self._mujoco.mjr_render(view, self._scene, self._rendering)
        self._mujoco.mjr_readPixels(pixels, None, view, self._rendering)
        return pixels[::-1]

    def _plan(self, k: int) -> tuple[Array, Array]:
        """Returns means (H, 3) and covariances (H, 3, 3) of the planned positions."""
        means = self._run.plan_means[k][:, self.axes]
        covariances = self._run.plan_covariances[k][:, self.axes][..., self.axes]
        has_mean = np.isfinite(means).all(axis=1)
        has_covariance = np.isfinite(covariances).all(axis=(1, 2))
        is_finite = has_mean & has_covariance
        return means[is_finite], covariances[is_finite]

    def _add_paths(self, k: int) -> None:
        """Adds the reference, the path flown so far, and the plan."""
        first = max(0, k - _TRAIL)
        breaks = self._gaps[(self._gaps > first) & (self._gaps <= k)] - first
        flown_path = broken(self._run.states[first : k + 1, self.axes], breaks)
        planned_path, _ = self._plan(k)
        self._add_path(self._reference_path, REFERENCE)
        self._add_path(flown_path, FLOWN)
        self._add_path(planned_path, PLAN)

    def _add_path(self, points: Array, colour: str) -> None:
        """Adds thin rods from point to point; none from or to a point that is NaN."""
        capsule = self._mujoco.mjtGeom.mjGEOM_CAPSULE
        for begin, end in pairwise(points):
            if not np.isfinite([begin, end]).all():
                continue
            rod = self._add_shape(
                capsule,
                size=np.zeros(3),
                position=np.zeros(3),
                rotation=np.eye(3),
                colour=to_rgba(colour),
            )
            if rod is not None:
                self._mujoco.mjv_connector(rod, capsule, 0.008, begin, end)

    def _add_tube(self, k: int) -> None:
        """Adds the 2-sigma ellipsoids of the planned positions."""
        means, covariances = self._plan(k)
        for mean, covariance in zip(means, covariances, strict=True):
            variances, rotation = np.linalg.eigh(covariance)
            rotation[:, 0] *= np.sign(np.linalg.det(rotation))
            stds = np.sqrt(np.maximum(variances, 0))
            half_axes = np.maximum(2 * self._enlarged * stds, 1e-3)
            self._add_shape(
                self._mujoco.mjtGeom.mjGEOM_ELLIPSOID,
                size=half_axes,
                position=mean,
                rotation=rotation,
                colour=to_rgba(PLAN, 0.15),
            )

    def _add_shape(
        self,
        kind: Any,
        *,
        size: Array,
        position: Array,
        rotation: Array,
        colour: tuple[float, float, float, float],
    ) -> Any:
        """Adds a shape and returns it; None where the scene is full."""
        if self._scene.ngeom == self._scene.maxgeom:
            return None
        shape = self._scene.geoms[self._scene.ngeom]
        self._mujoco.mjv_initGeom(
            shape,
            kind,
            size,
            position,
            rotation.ravel(),
            np.array(colour, dtype=np.float32),
        )
        shape.emission = 0.5
        self._scene.ngeom += 1
        return shape
