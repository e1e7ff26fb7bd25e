"""Films a recorded flight of a MuJoCo model, rendered without a screen."""

import os
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from gpmpc.exceptions import SettingError, UnsupportedModel
from gpmpc.plotting._animation import save_animation
from gpmpc.plotting._style import FLOWN, PLAN, REFERENCE

if TYPE_CHECKING:
    from gpmpc.recording import Run
    from gpmpc.systems import System

Array = np.ndarray
# of MuJoCo's off-screen buffer
_WIDTH = 640
_HEIGHT = 480


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
        system: What flew: its ``dynamics`` have a MuJoCo ``model``, and ``positions``
            from a state (n,) to those of the model's joints (nq,), as a system of
            joints has.
        path: The file, .gif or .mp4 (which needs ffmpeg).
        frames: At most so many; steps are left out evenly.
        enlarged: Factor of the tube's 2-sigma ellipsoids.

    Raises:
        SettingError: There is no off-screen rendering here.
        UnsupportedModel: The system is none of MuJoCo whose state says where its joints
            are, or no step was recorded.
    """
    if not len(run.times) or not (
        hasattr(system.dynamics, "model") and hasattr(system.dynamics, "positions")
    ):
        raise UnsupportedModel(
            f"{run.path}: a film needs steps of a MuJoCo model, "
            "and its joints' positions"
        )
    try:
        mujoco = import_module("mujoco")
        chosen = "MUJOCO_GL" in os.environ or "DISPLAY" in os.environ
        context = import_module(
            "mujoco.gl_context" if chosen else "mujoco.egl"
        ).GLContext(_WIDTH, _HEIGHT)
        context.make_current()
    except Exception as error:  # of ctypes, of PyOpenGL, of a driver
        raise SettingError(
            "film",
            "no off-screen rendering by MuJoCo here; gpmpc.plotting.animate draws "
            f"flights without it ({error})",
        ) from error
    try:
        scene = _Scene(mujoco, run, system.dynamics, enlarged)
        figure = Figure(figsize=(_WIDTH / 80, _HEIGHT / 80))
        figure.set_layout_engine("none")  # the picture fills it
        FigureCanvasAgg(figure)
        image = figure.add_axes((0, 0, 1, 1)).imshow(scene.render(0), aspect="auto")
        image.axes.set_axis_off()
        clock = figure.text(0.02, 0.95, "")
        legend = (
            (("reference", REFERENCE), ("flown", FLOWN), ("plan and its tube", PLAN))
            if scene.axes
            else ()
        )
        for i, (name, color) in enumerate(legend):
            figure.text(0.02, 0.02 + 0.04 * i, name, color=color, weight="bold")

        def draw(k: int) -> None:
            image.set_data(scene.render(k))
            clock.set_text(f"{run.times[k]:.2f} s")

        save_animation(figure, draw, len(run.times), path, frames)
        scene.rendering.free()
    finally:
        context.free()


class _Scene:
    """The scene of a flight, rendered step by step."""

    def __init__(self, mujoco: Any, run: "Run", dynamics: Any, enlarged: float):
        self.mujoco = mujoco
        self.run = run
        self.positions = dynamics.positions
        self.enlarged = enlarged
        self.model = dynamics.model
        self.data = mujoco.MjData(self.model)
        self.scene = mujoco.MjvScene(self.model, 2000)
        self.rendering = mujoco.MjrContext(
            self.model, mujoco.mjtFontScale.mjFONTSCALE_100
        )
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.rendering)
        self.axes = (
            [run.pose[axis] for axis in "xyz"]
            if {"x", "y", "z"} <= run.pose.keys()
            else []
        )
        self.thinned = run.references[:: max(1, len(run.times) // 300)][:, self.axes]

    def render(self, k: int) -> Array:
        """Returns the picture (height, width, 3) of step k.

        A camera follows a vehicle that has a position.
        """
        mujoco = self.mujoco
        run = self.run
        self.data.qpos[:] = self.positions(run.states[k])
        mujoco.mj_forward(self.model, self.data)
        camera = mujoco.MjvCamera()
        option = mujoco.MjvOption()
        mujoco.mjv_defaultFreeCamera(self.model, camera)
        if self.axes:
            camera.lookat[:] = run.states[k, self.axes]
            camera.distance = 2.2
            camera.elevation = -25
            camera.azimuth = 120
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self.model, self.data, option, None, camera, every, self.scene
        )
        if self.axes:
            self._draw_paths(k)
        view = mujoco.MjrRect(0, 0, _WIDTH, _HEIGHT)
        pixels = np.empty((_HEIGHT, _WIDTH, 3), dtype=np.uint8)
        mujoco.mjr_render(view, self.scene, self.rendering)
        mujoco.mjr_readPixels(pixels, None, view, self.rendering)
        return pixels[::-1]

    def _draw_paths(self, k: int) -> None:
        """Adds the reference, the way flown so far, and the plan with its tube."""
        run = self.run
        plan = run.plan_means[k][:, self.axes]
        covariances = run.plan_covariances[k][:, self.axes][..., self.axes]
        finite = np.isfinite(plan).all(axis=1) & np.isfinite(covariances).all(
            axis=(1, 2)
        )
        capsule = self.mujoco.mjtGeom.mjGEOM_CAPSULE
        ellipsoid = self.mujoco.mjtGeom.mjGEOM_ELLIPSOID
        flown = run.states[max(0, k - 200) : k + 1, self.axes]
        for points, color in (
            (self.thinned, REFERENCE),
            (flown, FLOWN),
            (plan[finite], PLAN),
        ):
            for begin, end in pairwise(points):
                if geom := self._add(
                    capsule, np.zeros(3), np.zeros(3), np.eye(3), to_rgba(color)
                ):
                    self.mujoco.mjv_connector(geom, capsule, 0.008, begin, end)
        for mean, covariance in zip(plan[finite], covariances[finite], strict=True):
            squared, turn = np.linalg.eigh(covariance)
            turn[:, 0] *= np.sign(np.linalg.det(turn))
            axes = np.maximum(2 * self.enlarged * np.sqrt(np.maximum(squared, 0)), 1e-3)
            self._add(ellipsoid, axes, mean, turn, to_rgba(PLAN, 0.15))

    def _add(
        self, kind: Any, size: Array, place: Array, turn: Array, color: Any
    ) -> Any:
        """Adds a shape; None where the scene is full."""
        if self.scene.ngeom == self.scene.maxgeom:
            return None
        geom = self.scene.geoms[self.scene.ngeom]
        self.mujoco.mjv_initGeom(
            geom, kind, size, place, turn.ravel(), np.array(color, dtype=np.float32)
        )
        geom.emission = 0.5
        self.scene.ngeom += 1
        return geom
