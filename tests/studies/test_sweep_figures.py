"""Figures of a sweep."""

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from gpmpc.plotting import Series, over_variable


@pytest.mark.parametrize(
    "label",
    [
        "horizon=1",
        "data.size=189",
        "controller=nonlinear",
        "propagation=mean_equivalence",
    ],
)
@pytest.mark.parametrize("count", [2, 3, 6])
def test_a_legend_stays_within_its_figure(label, count):
    figure = over_variable(
        "horizon", ["1", "5"], "RMSE [m]", [Series(label, [[1.0], [2.0]])] * count
    )
    FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1


def test_a_lone_flight_is_drawn_on_its_tick_and_others_beside():
    both = [Series("a", [[1.0], [2.0], []]), Series("b", [[1.0], [], [3.0]])]
    figure = over_variable("controller", ["x", "y", "z"], "RMSE [m]", both)
    (axis,) = figure.axes
    centres = [line.get_xdata() for line in axis.lines if line.get_marker() == "o"]
    assert [list(of_line) for of_line in centres] == [
        [pytest.approx(-0.07), 1.0],
        [pytest.approx(0.07), 2.0],
    ]
