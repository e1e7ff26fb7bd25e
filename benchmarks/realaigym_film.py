"""Draws a flight of the league's double pendulum as a GIF.

Links, the tip's path of the last half second, the line.
"""

from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.realaigym import INPUT, LENGTHS, LINE, TORQUE, Play

RATE = 20  # frames a second


def film(flight: Play, joint: int, path: Path) -> None:
    """Writes the flight of a pendulum with the motor at a joint (0, 1)."""
    first, second = LENGTHS
    angle = flight.states[:, 0]
    both = flight.states[:, 0] + flight.states[:, 1]
    elbow = np.stack([first * np.sin(angle), -first * np.cos(angle)], axis=1)
    tip = elbow + np.stack([second * np.sin(both), -second * np.cos(both)], axis=1)
    figure = Figure(figsize=(4, 4.4))
    FigureCanvasAgg(figure)
    axes = figure.add_axes(
        (0.02, 0.12, 0.96, 0.86), xlim=(-0.56, 0.56), ylim=(-0.56, 0.56), aspect="equal"
    )
    axes.axis("off")
    axes.axhline(LINE, color="0.6", linestyle="--")
    (path_line,) = axes.plot([], [], color="tab:orange", linewidth=1)
    (links,) = axes.plot([], [], "o-", color="tab:blue", linewidth=5, markersize=9)
    gauge = figure.add_axes(
        (0.3, 0.05, 0.65, 0.04), xlim=(-TORQUE, TORQUE), ylim=(-0.5, 0.5), yticks=[]
    )
    gauge.tick_params(labelsize=7)
    (bar,) = gauge.barh([0], [0.0], height=1.0, color="tab:green")
    clock = figure.text(0.03, 0.94, "")
    name = "elbow" if joint else "shoulder"
    figure.text(0.03, 0.055, f"{name} torque [N m]", fontsize=7)

    def draw(k: int) -> list:
        path_line.set_data(*tip[max(0, k - round(0.5 / INPUT)) : k + 1].T)
        links.set_data(*np.array([[0.0, 0.0], elbow[k], tip[k]]).T)
        bar.set_width(flight.torques[k, joint])
        clock.set_text(f"{k * INPUT:.1f} s")
        return []

    frames = range(0, len(flight.torques), round(1 / RATE / INPUT))
    FuncAnimation(figure, draw, frames=frames, cache_frame_data=False).save(
        path, writer=PillowWriter(RATE), dpi=70
    )
