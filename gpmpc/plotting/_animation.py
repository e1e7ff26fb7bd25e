"""Animates a flight: the way flown, the plan, and how certain the plan was.

Left the whole flight from above (x, y) and its height, right what the controller saw:
its plan with 2-sigma ellipses of the predicted positions. These are often far smaller
than the plan is long; they are then drawn enlarged, and the factor is written into the
picture.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from gpmpc.exceptions import UnsupportedModel
from gpmpc.plotting._style import DASHED, FLOWN, PLAN, REFERENCE, TUBE, styled

if TYPE_CHECKING:
    from gpmpc.recording import Run

_FRAMES = 150  # at most; steps are left out evenly
_RATE = 15  # frames a second
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Half axis of an ellipse, as a share of the view, from which on it is large enough.
_VISIBLE = 0.06


def animate(run: "Run", path: str | Path) -> None:
    """Writes the flight as a GIF, or as an MP4 by the file's ending.

    Args:
        run: A recording whose ``pose`` has x, y and z.
        path: The file, .gif or .mp4 (which needs ffmpeg).
    """
    if not {"x", "y", "z"} <= run.pose.keys() or not len(run.times):
        raise UnsupportedModel(
            f"{run.path}: an animation needs steps with positions x, y and z"
        )
    save_animation(*_scene(run), len(run.times), path)


def save_animation(
    figure: Figure,
    draw: Callable[[int], None],
    steps: int,
    path: str | Path,
    frames: int = _FRAMES,
) -> None:
    """Writes a figure that is drawn anew for evenly chosen steps, as ``animate``."""
    shown = np.unique(np.linspace(0, steps - 1, min(frames, steps)).astype(int))
    writer = (
        FFMpegWriter(fps=_RATE)
        if Path(path).suffix == ".mp4"
        else PillowWriter(fps=_RATE)
    )
    FuncAnimation(figure, draw, frames=shown, blit=False, cache_frame_data=False).save(
        str(path), writer, dpi=80
    )


@styled
def _scene(run: "Run") -> tuple[Figure, Callable[[int], None]]:
    """The figure, and the function of a step's number that draws it."""
    plane = [run.pose["x"], run.pose["y"]]
    up = run.pose["z"]
    sign, axis_name = (
        (-1, "-z") if run.metadata.get("frames", {}).get("z axis") != "up" else (1, "z")
    )
    states = run.states[:, plane]
    references = run.references[:, plane]
    plans = run.plan_means[:, :, plane]
    covariances = run.plan_covariances[:, :, plane][..., plane]
    whole: Any = np.isfinite(plans).all(axis=2)  # a shorter plan ends in NaN

    figure = Figure(figsize=(10, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.15], height_ratios=[2.4, 1])
    above, height, near = (
        figure.add_subplot(grid[place]) for place in ((0, 0), (1, 0), (slice(None), 1))
    )
    dashed: dict[str, Any] = {"color": REFERENCE, "linewidth": 1, "linestyle": DASHED}
    for axis in (above, near):
        axis.plot(*references.T, **dashed)
        axis.set(xlabel="x [m]", ylabel="y [m]")
        axis.set_aspect("equal", adjustable="box")
    (dashes,) = height.plot(run.times, sign * run.references[:, up], **dashed)
    height.set(xlabel="time [s]", ylabel=f"height, {axis_name} [m]")
    # The last plans lead on from where the flight ends; those of failed solves may be
    # anywhere.
    drawn = np.concatenate([states, references, plans[whole & ~run.failed[:, None]]])
    low = drawn.min(axis=0)
    high = drawn.max(axis=0)
    _look_at(above, (low + high) / 2, 0.56 * max((high - low).max(), 1.0))

    complete = plans[
        whole.all(axis=1)
    ]  # half the width of the view that almost every plan fits into [m]
    half = (
        max(0.62 * float(np.quantile(np.ptp(complete, axis=1).max(axis=1), 0.98)), 0.5)
        if len(complete)
        else 1.0
    )
    stds = run.plan_stds[:, :, plane][whole]
    largest = 2 * float(np.median(stds.max(axis=1))) if len(stds) else 0.0
    fitting = (factor for factor in _FACTORS if factor * largest >= _VISIBLE * 2 * half)
    factor = next(fitting, _FACTORS[-1]) if largest > 0 else 1
    enlarged = f", the tube {factor} times enlarged" if factor > 1 else ""
    near.set_title(f"plan with its 2-sigma tube{enlarged}", fontsize="medium")
    trails = [
        axis.plot([], [], color=FLOWN, linewidth=1.6)[0] for axis in (above, near)
    ]
    ahead = [axis.plot([], [], color=PLAN, linewidth=1.4)[0] for axis in (above, near)]
    ahead[1].set(marker="o", markersize=3)
    dots = [
        axis.plot([], [], "o", color=FLOWN, markersize=7, zorder=5)[0]
        for axis in (above, near)
    ]
    (target,) = near.plot([], [], "x", color=REFERENCE, markersize=8, zorder=4)
    (climbed,) = height.plot([], [], color=FLOWN, linewidth=1.6)
    shown = [climbed, dashes, ahead[1]]
    figure.legend(
        shown,
        ["flown", "reference", "plan"],
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    clock = figure.suptitle(" ", fontsize="medium")
    tubes: list = []

    def draw(k: int) -> None:
        for lines, points in (
            (trails, states[: k + 1]),
            (ahead, plans[k]),
            (dots, states[k : k + 1]),
        ):
            for line in lines:
                line.set_data(*points.T)
        target.set_data(*references[k, :, None])
        climbed.set_data(run.times[: k + 1], sign * run.states[: k + 1, up])
        stages = plans[k][whole[k]]
        spread = covariances[k][whole[k]]
        _look_at(
            near,
            (stages.min(axis=0) + stages.max(axis=0)) / 2
            if whole[k].all()
            else states[k],
            half,
        )
        while tubes:
            tubes.pop().remove()
        if spread.any():
            squared, directions = np.linalg.eigh(spread)
            minor, major = (
                4 * factor * np.sqrt(squared.clip(0)).T
            )  # whole axes of the 2-sigma ellipses
            angles = np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1]))
            look: Any = {
                "facecolors": TUBE,
                "edgecolors": FLOWN,
                "alpha": 0.45,
                "linewidths": 0.6,
                "zorder": 1,
            }
            where: Any = {
                "units": "xy",
                "offsets": stages,
                "transOffset": near.transData,
            }
            tubes.append(
                near.add_collection(
                    EllipseCollection(major, minor, angles, **where, **look)
                )
            )
        distance = 100 * np.linalg.norm((run.states - run.references)[k, [*plane, up]])
        failed = "; solve failed" if run.failed[k] else ""
        clock.set_text(
            f"{run.times[k]:.4g} s: {distance:.1f} cm from the reference{failed}"
        )

    draw(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # once is enough: nothing that needs room changes
    return figure, draw


def _look_at(axis: Axes, centre: np.ndarray, half: float) -> None:
    axis.set(
        xlim=(centre[0] - half, centre[0] + half),
        ylim=(centre[1] - half, centre[1] + half),
    )
