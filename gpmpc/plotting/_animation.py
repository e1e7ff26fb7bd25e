"""Animates a flight: the path flown, the plan, and how certain the plan was.

Left the whole flight from above (x, y) and its height, right what the controller saw:
its plan with 2-sigma ellipses of the predicted positions, to scale. These are often far
smaller than the plan is long: how wide the tube is stands below, on an axis of its own.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gpmpc._calls import explains_arguments
from gpmpc._files import write_whole
from gpmpc.exceptions import SettingError, UnsupportedModel
from gpmpc.plotting._style import (
    DASHED,
    FLOWN,
    PLAN,
    REFERENCE,
    TUBE,
    broken,
    check_run,
    gaps_of,
    styled,
)

if TYPE_CHECKING:
    from gpmpc.recording import Run

Array = np.ndarray

_MOST_FRAMES = 150  # of longer flights, steps are left out evenly
_FRAME_RATE = 15  # frames per second
_DPI = 80
_LENGTHS = {"m": 1.0, "cm": 1e2, "mm": 1e3, "µm": 1e6}  # units, in one metre


@explains_arguments
def animate(run: "Run", path: str | Path) -> None:
    """Writes the flight as a GIF, or as an MP4 by the file's ending.

    Args:
        run: A recording whose ``pose`` has x, y and z.
        path: The file, .gif or .mp4 (which needs ffmpeg).

    Raises:
        SettingError: Another ending, or an MP4 where there is no ffmpeg.
        DataError: The recording has no step.
        UnsupportedModel: The recording has no position in space.
    """
    check_run(run)
    check_file(path)
    if not {"x", "y", "z"} <= run.pose.keys():
        raise UnsupportedModel(f"{run.path}: an animation needs positions x, y and z")
    picture = draw_flight(run)
    save_animation(picture.figure, picture.draw, len(run.times), path)


def check_file(path: str | Path) -> None:
    """Raises ``SettingError`` unless it is a GIF, or an MP4 and there is ffmpeg."""
    ending = Path(path).suffix
    if ending not in (".gif", ".mp4"):
        raise SettingError("path", f"must end in .gif or .mp4; got {path}")
    if ending == ".mp4" and not FFMpegWriter.isAvailable():
        raise SettingError("path", f"an MP4 needs ffmpeg, a GIF does not; got {path}")


def save_animation(
    figure: Figure,
    draw: Callable[[int], None],
    steps: int,
    path: str | Path,
    most_frames: int = _MOST_FRAMES,
) -> None:
    """Writes an animation of a figure that ``draw`` draws anew for a step.

    Args:
        figure: What is drawn.
        draw: Draws the step whose number it is given.
        steps: Number of steps; of more than ``most_frames``, evenly chosen ones.
        path: The file, .gif or .mp4.
        most_frames: Largest number of frames.
    """
    frame_count = min(most_frames, steps)
    frames = np.unique(np.linspace(0, steps - 1, frame_count).astype(int))
    writer_class = FFMpegWriter if Path(path).suffix == ".mp4" else PillowWriter
    writer = writer_class(fps=_FRAME_RATE)
    path = Path(path)
    # The writers know files by their names alone.
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder, path.name)
        # Matplotlib's FuncAnimation would draw every frame twice.
        with writer.saving(figure, str(draft), _DPI):
            for step in frames:
                draw(int(step))
                writer.grab_frame()
        write_whole(path, draft.read_bytes())


@styled
def draw_flight(run: "Run") -> "FlightPicture":
    """Draws the first step of a flight, laid out for all of them."""
    picture = FlightPicture(_read_flight(run))
    picture.draw(0)
    picture.figure.draw_without_rendering()
    # Once is enough: nothing that needs room changes.
    picture.figure.set_layout_engine("none")
    return picture


@dataclass(frozen=True)
class _Flight:
    """A recorded flight of K steps, seen from above and by its height."""

    times: Array  # (K,) [s]
    positions: Array  # (K, 2) x and y [m]
    heights: Array  # (K,) upwards [m]
    reference_positions: Array  # (K, 2)
    reference_heights: Array  # (K,)
    plans: Array  # (K, H + 1, 2) planned positions; NaN behind a shorter plan's end
    plan_covariances: Array  # (K, H + 1, 2, 2)
    plan_stds: Array  # (K, H + 1, 2)
    is_planned: Array  # (K, H + 1) whether the plan has that stage
    failed: Array  # (K,) whether the plan was not applied
    distances: Array  # (K,) from the reference [cm]
    gaps: Array  # rows before which steps are lost
    height_name: str

    def line(self, values: Array, last: int | None = None) -> Array:
        """Returns values (K, ...) of a line, broken where steps are lost.

        ``last`` is the row that it ends with; by default it is drawn to the end.
        """
        end = len(values) if last is None else last + 1
        return broken(values[:end], self.gaps[self.gaps < end])


def _read_flight(run: "Run") -> _Flight:
    """Takes what is drawn out of a recording."""
    plane = [run.pose["x"], run.pose["y"]]
    z = run.pose["z"]
    z_is_up = run.metadata.get("frames", {}).get("z axis") == "up"
    upwards = 1 if z_is_up else -1
    plans = run.plan_means[:, :, plane]
    errors = (run.states - run.references)[:, [*plane, z]]
    return _Flight(
        times=run.times,
        positions=run.states[:, plane],
        heights=upwards * run.states[:, z],
        reference_positions=run.references[:, plane],
        reference_heights=upwards * run.references[:, z],
        plans=plans,
        plan_covariances=run.plan_covariances[:, :, plane][..., plane],
        plan_stds=run.plan_stds[:, :, plane],
        is_planned=np.isfinite(plans[..., 0]) & np.isfinite(plans[..., 1]),
        failed=run.failed,
        distances=100 * np.linalg.norm(errors, axis=1),
        gaps=gaps_of(run),
        height_name="z" if z_is_up else "-z",
    )


class FlightPicture:
    """A figure of a flight, drawn anew for each step."""

    def __init__(self, flight: _Flight):
        self.figure = Figure(figsize=(10, 5.4), layout="constrained")
        FigureCanvasAgg(self.figure)
        grid = self.figure.add_gridspec(
            2, 2, width_ratios=[1, 1.15], height_ratios=[2.4, 1]
        )
        self._flight = flight
        self._overview = _MapPanel(self.figure.add_subplot(grid[0, 0]), flight)
        self._height = _HeightPanel(self.figure.add_subplot(grid[1, 0]), flight)
        self._close_up = _MapPanel(self.figure.add_subplot(grid[0, 1]), flight)
        self._close_up.plan.set(marker="o", markersize=3)
        self._half_width = _half_width_of_plans(flight)
        self._close_up.axis.set_title("plan with its 2-sigma tube", fontsize="medium")
        self._tube = _Tube(self._close_up.axis)
        self._width = _WidthPanel(self.figure.add_subplot(grid[1, 1]), flight)
        _look_at_flight(self._overview.axis, flight)
        (self._target,) = self._close_up.axis.plot(
            [], [], "x", color=REFERENCE, markersize=8, zorder=4
        )
        self.figure.legend(
            [self._height.flown, self._height.reference, self._close_up.plan],
            ["flown", "reference", "plan"],
            loc="outside lower center",
            ncols=3,
            frameon=False,
        )
        self._title = self.figure.suptitle(" ", fontsize="medium")

    def draw(self, k: int) -> None:
        """Draws step k."""
        flight = self._flight
        self._overview.draw(k)
        self._height.draw(k)
        self._close_up.draw(k)
        self._target.set_data(*flight.reference_positions[k, :, None])
        self._follow_plan(k)
        stages = flight.is_planned[k]
        self._tube.draw(flight.plans[k][stages], flight.plan_covariances[k][stages])
        self._width.draw(k)
        remark = "; plan not applied" if flight.failed[k] else ""
        self._title.set_text(
            f"{flight.times[k]:.4g} s: "
            f"{flight.distances[k]:.1f} cm from the reference{remark}"
        )

    def _follow_plan(self, k: int) -> None:
        """Moves the close-up to the middle of a complete plan, else to the vehicle."""
        plan = self._flight.plans[k]
        if self._flight.is_planned[k].all():
            centre = (plan.min(axis=0) + plan.max(axis=0)) / 2
        else:
            centre = self._flight.positions[k]
        _look_at(self._close_up.axis, centre, self._half_width)


class _MapPanel:
    """A view from above: reference, flown path, plan, and the vehicle."""

    def __init__(self, axis: Axes, flight: _Flight):
        self.axis = axis
        self._flight = flight
        axis.plot(
            *flight.line(flight.reference_positions).T,
            color=REFERENCE,
            linewidth=1,
            linestyle=DASHED,
        )
        axis.set(xlabel="x [m]", ylabel="y [m]")
        axis.set_aspect("equal", adjustable="box")
        (self.flown,) = axis.plot([], [], color=FLOWN, linewidth=1.6)
        (self.plan,) = axis.plot([], [], color=PLAN, linewidth=1.4)
        (self.vehicle,) = axis.plot([], [], "o", color=FLOWN, markersize=7, zorder=5)

    def draw(self, k: int) -> None:
        """Draws step k."""
        self.flown.set_data(*self._flight.line(self._flight.positions, k).T)
        self.plan.set_data(*self._flight.plans[k].T)
        self.vehicle.set_data(*self._flight.positions[k : k + 1].T)


class _HeightPanel:
    """The flown height over the time, against its reference."""

    def __init__(self, axis: Axes, flight: _Flight):
        self._flight = flight
        (self.reference,) = axis.plot(
            flight.line(flight.times),
            flight.line(flight.reference_heights),
            color=REFERENCE,
            linewidth=1,
            linestyle=DASHED,
        )
        axis.set(xlabel="time [s]", ylabel=f"height, {flight.height_name} [m]")
        (self.flown,) = axis.plot([], [], color=FLOWN, linewidth=1.6)

    def draw(self, k: int) -> None:
        """Draws the flight up to step k."""
        flight = self._flight
        self.flown.set_data(
            flight.line(flight.times, k), flight.line(flight.heights, k)
        )


class _WidthPanel:
    """Half the width of a plan's 2-sigma tube, over the steps ahead."""

    def __init__(self, axis: Axes, flight: _Flight):
        widths = 2 * flight.plan_stds
        widths[~flight.is_planned] = np.nan
        finite = widths[np.isfinite(widths)]
        largest = float(np.quantile(finite, 0.98)) if len(finite) else 0.0
        unit, scale = _length_unit(largest)
        self._widths = scale * widths  # (K, H + 1, 2)
        self._lines = [
            axis.plot([], [], color=colour, linestyle=dashes, label=name)[0]
            for name, colour, dashes in (("x", FLOWN, "-"), ("y", PLAN, DASHED))
        ]
        axis.set(
            xlabel="steps ahead",
            ylabel=f"2 sigma [{unit}]",
            xlim=(0, max(flight.plans.shape[1] - 1, 1)),
            ylim=(0, 1.15 * scale * largest or 1.0),
        )
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.legend(loc="lower right", ncols=2, fontsize="small")

    def draw(self, k: int) -> None:
        """Draws the plan of step k."""
        stages = np.arange(self._widths.shape[1])
        for line, widths in zip(self._lines, self._widths[k].T, strict=True):
            line.set_data(stages, widths)


def _length_unit(largest: float) -> tuple[str, float]:
    """Returns the unit in which a length [m] is 1 or more, and how many are a metre."""
    for unit, scale in _LENGTHS.items():
        if scale * largest >= 1:
            return unit, scale
    return "m", 1.0


class _Tube:
    """The 2-sigma ellipses of a plan's positions."""

    def __init__(self, axis: Axes):
        self._axis = axis
        self._ellipses: EllipseCollection | None = None

    def draw(self, means: Array, covariances: Array) -> None:
        """Draws ellipses of means (H, 2) and covariances (H, 2, 2) for the last ones.

        Nothing is drawn of a plan that is certain.
        """
        if self._ellipses is not None:
            self._ellipses.remove()
            self._ellipses = None
        if not covariances.any():
            return
        variances, directions = np.linalg.eigh(covariances)
        half_axes = 2 * np.sqrt(variances.clip(0))
        minor, major = 2 * half_axes.T
        major_direction = directions[:, :, 1]
        self._ellipses = EllipseCollection(
            widths=major,
            heights=minor,
            angles=np.degrees(np.arctan2(major_direction[:, 1], major_direction[:, 0])),
            units="xy",
            offsets=means,
            offset_transform=self._axis.transData,
            facecolors=TUBE,
            edgecolors=FLOWN,
            alpha=0.45,
            linewidths=0.6,
            zorder=1,
        )
        self._axis.add_collection(self._ellipses)


def _look_at_flight(axis: Axes, flight: _Flight) -> None:
    """Sets the limits of a view so that the whole flight lies in it, plans included.

    The last plans lead on from where the flight ends; those of failed solves may be
    anywhere.
    """
    trusted_stages = flight.is_planned & ~flight.failed[:, None]
    points = np.concatenate(
        [flight.positions, flight.reference_positions, flight.plans[trusted_stages]]
    )
    low = points.min(axis=0)
    high = points.max(axis=0)
    _look_at(axis, (low + high) / 2, 0.56 * max((high - low).max(), 1.0))


def _look_at(axis: Axes, centre: Array, half_width: float) -> None:
    """Sets the limits of a square view [m]."""
    x, y = centre
    axis.set(
        xlim=(x - half_width, x + half_width),
        ylim=(y - half_width, y + half_width),
    )


def _half_width_of_plans(flight: _Flight) -> float:
    """Returns half the width of a view that almost every plan fits into [m]."""
    complete_plans = flight.plans[flight.is_planned.all(axis=1)]
    if not len(complete_plans):
        return 1.0
    lengths = np.ptp(complete_plans, axis=1).max(axis=1)
    return max(0.62 * float(np.quantile(lengths, 0.98)), 0.5)
