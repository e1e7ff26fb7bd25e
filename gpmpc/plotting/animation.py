"""Animates a flight: where the vehicle was, what it planned, and how certain the plan was.

Left the whole flight from above (x, y) and its height, right what the controller saw: its plan with 2-sigma ellipses of
the predicted positions. These are often far smaller than the plan is long; they are then drawn enlarged, and the factor
is written into the picture.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from gpmpc.exceptions import UnsupportedModel
from gpmpc.plotting.recorded import FLOWN, REFERENCE, TUBE
from gpmpc.plotting.style import DASHED, GREEN, styled

if TYPE_CHECKING:
    from gpmpc.recording import Run

_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_VISIBLE = 0.06  # an ellipse's half axis, as a share of the view, from which on it is large enough
PLAN = GREEN


def animate(run: "Run", path: str | Path, frames: int = 150, rate: int = 15) -> None:
    """Writes the flight as a GIF, or as an MP4 by the file's ending.

    Args:
        run: A recording of a vehicle with states x, y and z.
        path: The file, .gif or .mp4 (which needs ffmpeg).
        frames: At most so many; steps are left out evenly.
        rate: Frames a second.
    """
    if not {"x", "y", "z"} <= set(run.state_names) or not len(run.times):
        raise UnsupportedModel(f"{run.path}: an animation needs steps with states x, y and z")
    figure, draw = _scene(run)
    shown = np.unique(np.linspace(0, len(run.times) - 1, min(frames, len(run.times))).astype(int))
    animation = FuncAnimation(figure, draw, frames=shown, blit=False, cache_frame_data=False)
    writer = FFMpegWriter(fps=rate) if Path(path).suffix == ".mp4" else PillowWriter(fps=rate)
    animation.save(str(path), writer=writer, dpi=80)


def ffmpeg_exists() -> bool:
    """Whether an MP4 can be written."""
    return shutil.which("ffmpeg") is not None


@styled
def _scene(run: "Run") -> tuple[Figure, Callable[[int], list]]:
    """The figure, and the function of a step's number that draws it."""
    x, y, z = (run.state_names.index(name) for name in "xyz")
    figure = Figure(figsize=(10, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.15], height_ratios=[2.4, 1])
    above, height, near = (figure.add_subplot(grid[place]) for place in ((0, 0), (1, 0), (slice(None), 1)))
    for axis in (above, near):
        axis.plot(run.references[:, x], run.references[:, y], color=REFERENCE, linewidth=1, linestyle=DASHED)
        axis.set_xlabel("x [m]")
        axis.set_ylabel("y [m]")
        axis.set_aspect("equal", adjustable="box")
    height.plot(run.times, -run.references[:, z], color=REFERENCE, linewidth=1, linestyle=DASHED, label="reference")
    height.set_xlabel("time [s]")
    height.set_ylabel("height, -z [m]")
    drawn = np.concatenate([run.states[:, [x, y]], run.references[:, [x, y]], _planned(run, x, y)])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    span = 0.56 * max((high - low).max(), 1.0)
    above.set_xlim((low + high)[0] / 2 - span, (low + high)[0] / 2 + span)
    above.set_ylim((low + high)[1] / 2 - span, (low + high)[1] / 2 + span)

    half = _view(run, x, y)
    factor = _enlargement(run, x, y, half)
    near.set_title(
        "plan with its 2-sigma tube" + (f", the tube {factor} times enlarged" if factor > 1 else ""), fontsize="medium"
    )
    trail, plan = (
        [axis.plot([], [], color=c, linewidth=w)[0] for axis in (above, near)] for c, w in ((FLOWN, 1.6), (PLAN, 1.4))
    )
    plan[1].set_marker("o")
    plan[1].set_markersize(3)
    vehicle = [axis.plot([], [], "o", color=FLOWN, markersize=7, zorder=5)[0] for axis in (above, near)]
    target = near.plot([], [], "x", color=REFERENCE, markersize=8, zorder=4)[0]
    climbed = height.plot([], [], color=FLOWN, linewidth=1.6, label="flown")[0]
    lines = [climbed, height.lines[0], plan[1]]
    figure.legend(lines, ["flown", "reference", "plan"], loc="outside lower center", ncols=3, frameon=False)
    clock = figure.suptitle(" ", fontsize="medium")
    tubes: list = []

    def draw(k: int) -> list:
        position = run.states[k, [x, y]]
        for line in trail:
            line.set_data(run.states[: k + 1, x], run.states[: k + 1, y])
        for line in plan:
            line.set_data(run.plan_means[k, :, x], run.plan_means[k, :, y])
        for dot in vehicle:
            dot.set_data(position[:1], position[1:])
        target.set_data(run.references[k, [x]], run.references[k, [y]])
        climbed.set_data(run.times[: k + 1], -run.states[: k + 1, z])
        centre = position if not np.isfinite(run.plan_means[k, :, [x, y]]).all() else _middle(run, k, x, y)
        near.set_xlim(centre[0] - half, centre[0] + half)
        near.set_ylim(centre[1] - half, centre[1] + half)
        while tubes:
            tubes.pop().remove()
        tubes.extend(_tube(run, k, x, y, factor, near))
        distance = 100 * np.linalg.norm((run.states - run.references)[k, [x, y, z]])
        failed = "; solve failed" if run.failed[k] else ""
        clock.set_text(f"{run.times[k]:.4g} s: {distance:.1f} cm from the reference{failed}")
        return []

    draw(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # once is enough: nothing that needs room changes
    return figure, draw


def _middle(run: "Run", k: int, x: int, y: int) -> np.ndarray:
    plan = run.plan_means[k][:, [x, y]]
    plan = plan[np.isfinite(plan).all(axis=1)]
    return (plan.min(axis=0) + plan.max(axis=0)) / 2 if len(plan) else run.states[k, [x, y]]


def _planned(run: "Run", x: int, y: int) -> np.ndarray:
    """Positions of all plans that solves ended with (k, 2): the last ones lead on from where the flight ends."""
    positions = run.plan_means[~run.failed][:, :, [x, y]].reshape(-1, 2)
    return positions[np.isfinite(positions).all(axis=1)]


def _view(run: "Run", x: int, y: int) -> float:
    """Half the width of the view that every plan fits into [m]."""
    plans = run.plan_means[:, :, [x, y]]
    finite = np.isfinite(plans).all(axis=(1, 2))
    if not finite.any():
        return 1.0
    return max(0.62 * float(np.quantile(np.ptp(plans[finite], axis=1).max(axis=1), 0.98)), 0.5)


def _enlargement(run: "Run", x: int, y: int, half: float) -> int:
    stds = run.plan_stds[:, :, [x, y]]
    largest = 2 * float(np.nanmedian(np.nanmax(stds, axis=(1, 2)))) if np.isfinite(stds).any() else 0.0
    if largest <= 0:
        return 1
    return next((factor for factor in _FACTORS if factor * largest >= _VISIBLE * 2 * half), _FACTORS[-1])


def _tube(run: "Run", k: int, x: int, y: int, factor: int, axis) -> list:
    """Ellipses of two standard deviations around the planned positions."""
    covariances = run.plan_covariances[k][:, [[x, x], [y, y]], [[x, y], [x, y]]]
    means = run.plan_means[k][:, [x, y]]
    known = np.isfinite(covariances).all(axis=(1, 2)) & np.isfinite(means).all(axis=1)
    if not known.any() or not covariances[known].any():
        return []
    values, vectors = np.linalg.eigh(covariances[known])
    axes = 4 * factor * np.sqrt(values.clip(0))  # whole axes of the 2-sigma ellipse
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    ellipses = EllipseCollection(
        axes[:, 1],
        axes[:, 0],
        angles,
        units="xy",
        offsets=means[known],
        transOffset=axis.transData,
        facecolors=TUBE,
        edgecolors=FLOWN,
        alpha=0.45,
        linewidths=0.6,
        zorder=1,
    )
    return [axis.add_collection(ellipses)]
