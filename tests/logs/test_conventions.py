"""A log of a rigid body that contradicts its mapping is refused, and what fits is named.

Forty mistakes in conventions, single and in pairs, on one flight; and right logs of many
vehicles, with noise like that of real ones, of which none is refused.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import DataError
from gpmpc.logs import read_log

sys.path.append(str(Path(__file__).resolve().parents[2]))
from tests.logs.flights import FRD, MAPPING, NED, Flight, fly, late

DEGREES = 180 / np.pi


def stored(folder, flight, name="flight"):
    """The flight as a file; an archive is read faster than text."""
    table = flight.to_pandas() if isinstance(flight, Flight) else flight
    path = folder / f"{name}.npz"
    np.savez(path, **{column: table[column].to_numpy() for column in table})
    return path


def with_states(**signals):
    """The mapping with other keys of some states."""
    states = {
        name: {**own, **signals.get(name, {})}
        for name, own in MAPPING["states"].items()
    }
    return {**MAPPING, "states": states}


@pytest.fixture(scope="module")
def flight():
    return fly(seconds=14)


def negative(vectors, *axes):
    vectors = vectors.copy()
    vectors[:, axes] *= -1
    return vectors


def times(vectors, factor, axis):
    vectors = vectors.copy()
    vectors[:, axis] *= factor
    return vectors


def in_ned(flight):
    """Attitudes of a FRD body in a NED world."""
    return Rotation.from_matrix(NED @ flight.attitude.as_matrix() @ FRD).as_quat()


def of_frd(flight):
    """Attitudes of a FRD body in an ENU world."""
    return Rotation.from_matrix(flight.attitude.as_matrix() @ FRD).as_quat()


def inverse(flight):
    return flight.attitude.inv().as_quat()


def scalar_first(q):
    return q[:, [3, 0, 1, 2]]


MISTAKES = {
    "quaternions with the scalar first": (
        lambda f: f.change(q=scalar_first(f.q)),
        ["order: wxyz for attitude"],
    ),
    "inverse quaternions": (
        lambda f: f.change(q=inverse(f)),
        ["from world to body", "scale: [-1, -1, -1, 1] for attitude"],
    ),
    "rates FRD": (lambda f: f.change(w=f.w @ FRD), ["FRD", "axes: ned for rate"]),
    "an attitude NED and FRD": (
        lambda f: f.change(q=in_ned(f)),
        ["NED", "axes: ned for attitude"],
    ),
    "an attitude FRD": (
        lambda f: f.change(q=of_frd(f)),
        ["FRD", "columns: [qw, qz, qy, qx]", "scale: [1, 1, -1, -1] for attitude"],
    ),
    "an attitude in a NED world": (
        lambda f: f.change(q=Rotation.from_matrix(NED @ f.attitude.as_matrix()).as_quat()),
        ["in a world in NED axes"],
    ),
    "a velocity NED": (lambda f: f.change(v=f.v @ NED), ["axes: ned for velocity"]),
    "a position NED": (lambda f: f.change(p=f.p @ NED), ["axes: ned for position"]),
    "position and velocity NED": (
        lambda f: f.change(p=f.p @ NED, v=f.v @ NED),
        ["axes: ned for position", "axes: ned for velocity"],
    ),
    "attitude and rate NED and FRD": (
        lambda f: f.change(q=in_ned(f), w=f.w @ FRD),
        ["axes: ned for attitude", "axes: ned for rate"],
    ),
    "all NED and FRD": (
        lambda f: f.change(p=f.p @ NED, q=in_ned(f), v=f.v @ NED, w=f.w @ FRD),
        ["gravity", "frame: ned"],
    ),
    "x of the velocity flipped": (
        lambda f: f.change(v=negative(f.v, 0)),
        ["x of velocity has the opposite sign", "scale: [-1, 1, 1] for velocity"],
    ),
    "y of the velocity flipped": (
        lambda f: f.change(v=negative(f.v, 1)),
        ["y of velocity", "scale: [1, -1, 1] for velocity"],
    ),
    "z of the velocity flipped": (
        lambda f: f.change(v=negative(f.v, 2)),
        ["z of velocity", "scale: [1, 1, -1] for velocity"],
    ),
    "the velocity flipped": (lambda f: f.change(v=-f.v), ["scale: -1 for velocity"]),
    "x of the position flipped": (
        lambda f: f.change(p=negative(f.p, 0)),
        ["x of position", "scale: [-1, 1, 1] for position"],
    ),
    "x of the rate flipped": (
        lambda f: f.change(w=negative(f.w, 0)),
        ["scale: [-1, 1, 1] for rate"],
    ),
    "y of the rate flipped": (
        lambda f: f.change(w=negative(f.w, 1)),
        ["scale: [1, -1, 1] for rate"],
    ),
    "z of the rate flipped": (
        lambda f: f.change(w=negative(f.w, 2)),
        ["scale: [1, 1, -1] for rate"],
    ),
    "x and y of the velocity swapped": (
        lambda f: f.change(v=f.v[:, [1, 0, 2]]),
        ["x and y of velocity have changed places", "columns: [vy, vx, vz]"],
    ),
    "x and y of the position swapped": (
        lambda f: f.change(p=f.p[:, [1, 0, 2]]),
        ["columns: [py, px, pz] for position"],
    ),
    "x and y of the rate swapped": (
        lambda f: f.change(w=f.w[:, [1, 0, 2]]),
        ["columns: [wy, wx, wz] for rate"],
    ),
    "x and y of position and velocity swapped": (
        lambda f: f.change(p=f.p[:, [1, 0, 2]], v=f.v[:, [1, 0, 2]]),
        ["columns: [py, px, pz]", "columns: [vy, vx, vz]"],
    ),
    "x and y of the quaternion swapped": (
        lambda f: f.change(q=f.q[:, [1, 0, 2, 3]]),
        ["columns: [qy, qx, qz, qw]"],
    ),
    "x of the quaternion flipped": (
        lambda f: f.change(q=negative(f.q, 0)),
        ["x of attitude", "scale: [-1, 1, 1, 1] for attitude"],
    ),
    "rates in world axes": (
        lambda f: f.change(w=f.attitude.apply(f.w)),
        ["in world axes", "not in body axes", "frame: world for rate"],
    ),
    "velocities in body axes": (
        lambda f: f.change(v=f.attitude.inv().apply(f.v)),
        ["in body axes", "frame: body for velocity"],
    ),
    "rates in degrees": (
        lambda f: f.change(w=DEGREES * f.w),
        ["rate is 57.3 times the derivative of attitude", "unit: deg/s for rate"],
    ),
    "one rate in degrees": (
        lambda f: f.change(w=times(f.w, DEGREES, 0)),
        ["x of rate is 57.3 times", "scale: [0.017453, 1, 1] for rate"],
    ),
    "velocities in mm/s": (
        lambda f: f.change(v=1e3 * f.v),
        ["velocity is 1e+03 times", "unit: mm/s for velocity"],
    ),
    "velocities in km/h": (
        lambda f: f.change(v=3.6 * f.v),
        ["velocity is 3.6 times", "unit: km/h for velocity"],
    ),
    "positions in feet": (
        lambda f: f.change(p=f.p / 0.3048),
        ["velocity is 0.305 times", "unit: ft for position"],
    ),
    "positions and velocities in cm": (
        lambda f: f.change(p=100 * f.p, v=100 * f.v),
        ["gravity", "unit: cm for position", "unit: cm/s for velocity"],
    ),
    "an attitude 0.2 s late": (
        lambda f: f.change(q=late(f.q, 20)),
        ["attitude comes 0.2 s after rate", "delay: 0.2 for attitude"],
    ),
    "rates 0.5 s late": (
        lambda f: f.change(w=late(f.w, 50)),
        ["rate comes 0.5 s after attitude", "delay: 0.5 for rate"],
    ),
    "velocities 0.3 s late": (
        lambda f: f.change(v=late(f.v, 30)),
        ["velocity comes 0.3 s after position"],
    ),
    "the scalar first and a velocity NED": (
        lambda f: f.change(q=scalar_first(f.q), v=f.v @ NED),
        ["order: wxyz for attitude", "axes: ned for velocity"],
    ),
    "the scalar first and rates in degrees": (
        lambda f: f.change(q=scalar_first(f.q), w=DEGREES * f.w),
        ["order: wxyz for attitude", "unit: deg/s for rate"],
    ),
    "the scalar first and rates FRD": (
        lambda f: f.change(q=scalar_first(f.q), w=f.w @ FRD),
        ["order: wxyz for attitude", "axes: ned for rate"],
    ),
    "the scalar first and 0.2 s late": (
        lambda f: f.change(q=late(scalar_first(f.q), 20)),
        ["order: wxyz for attitude", "delay: 0.2 for attitude"],
    ),
    "the scalar first of inverse quaternions": (
        lambda f: f.change(q=scalar_first(inverse(f))),
        ["order: wxyz for attitude", "scale: [-1, -1, -1, 1] for attitude"],
    ),
    "rates FRD and a velocity NED": (
        lambda f: f.change(w=f.w @ FRD, v=f.v @ NED),
        ["axes: ned for velocity", "axes: ned for rate"],
    ),
    "rates late and one flipped": (
        lambda f: f.change(w=late(negative(f.w, 2), 50)),
        ["scale: [1, 1, -1] for rate", "delay: 0.5 for rate"],
    ),
    "velocities in body axes, FRD": (
        lambda f: f.change(v=f.attitude.inv().apply(f.v) @ FRD),
        ["frame: body for velocity", "axes: ned for velocity"],
    ),
    "positions in mm and a velocity NED": (
        lambda f: f.change(p=1e3 * f.p, v=f.v @ NED),
        ["unit: mm for position", "axes: ned for velocity"],
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_conventions_is_refused_and_named(mistake, flight, tmp_path):
    spoil, expected = MISTAKES[mistake]
    with pytest.raises(DataError) as refusal:
        read_log(stored(tmp_path, spoil(flight)), MAPPING)
    text = str(refusal.value)
    assert "\n" not in text
    missing = [words for words in expected if words not in text]
    assert not missing, text
