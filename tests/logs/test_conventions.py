"""A log of a rigid body that contradicts its mapping is refused; what fits is named.

Forty-five mistakes in conventions, single and in pairs, on one flight; and right logs
of many vehicles, with noise like that of real ones, of which none is refused.
"""

import os
import struct
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import LogMapping, read_log

sys.path.append(str(Path(__file__).resolve().parents[2]))
from tests.logs.flights import (
    FRD,
    MAPPING,
    NED,
    Flight,
    drive,
    fly,
    late,
    loop,
    sail,
    soar,
    tumble,
)

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


def remarks(log):
    """The findings about conventions."""
    return [f for f in log.findings if f.kind in ("late", "upside down")]


@pytest.fixture(scope="module")
def flight():
    return fly(seconds=14)


def test_a_log_too_short_to_be_checked_says_so(tmp_path, flight):
    table = flight.to_pandas()
    few = table.iloc[: 9 * len(table) // 10 : 30].head(45)
    (finding,) = read_log(stored(tmp_path, few), MAPPING).findings
    assert finding.kind == "unchecked"
    assert "too few rows without a gap to tell whether axes" in finding.text


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
        lambda f: f.change(
            q=Rotation.from_matrix(NED @ f.attitude.as_matrix()).as_quat()
        ),
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
        ["velocity is 0.305 times", "for position (ft)"],
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


def with_glitches(flight):
    """One row in fifty of every signal is wrong by much."""
    rng = np.random.default_rng(1)
    arrays = {}
    for name, size in (("p", 5.0), ("v", 20.0), ("w", 40.0)):
        values = getattr(flight, name).copy()
        rows = rng.choice(len(values), len(values) // 50, replace=False)
        values[rows] += size * rng.normal(size=(len(rows), 3))
        arrays[name] = values
    return flight.change(**arrays)


def with_signs_that_flip(flight):
    signs = np.random.default_rng(2).choice([-1.0, 1.0], len(flight.t))
    return flight.change(q=flight.q * signs[:, None])


def with_gps(flight):
    """Positions that wander and come ten times a second, and velocities with noise."""
    rng = np.random.default_rng(3)
    wander = 0.01 * np.cumsum(rng.normal(size=flight.p.shape), axis=0)
    coarse = (flight.p + wander)[::10]
    p = [np.interp(flight.t, flight.t[::10], column) for column in coarse.T]
    v = flight.v + 0.2 * rng.normal(size=flight.v.shape)
    return flight.change(p=np.column_stack(p), v=v)


RIGHT = {
    "a flight": lambda: fly(seed=1),
    "a hover": lambda: fly(size=0.01, turning=0.0, heading=0.0),
    "a fast turn": lambda: fly(heading=8.0, turning=0.0),
    "large tilts": lambda: fly(size=3.0),
    "much noise": lambda: fly(noise=10.0),
    "noise alone": lambda: fly(size=0.05, noise=30.0),
    "a gyroscope's offset": lambda: fly(offset=0.3),
    "ten rows a second": lambda: fly(rate=10.0, seconds=100.0),
    "a thousand rows a second": lambda: fly(rate=1000.0, seconds=8.0),
    "loops": loop,
    "a car on hills": drive,
    "an aeroplane": soar,
    "a boat in waves": sail,
    "a body that is carried about": tumble,
    "glitches": lambda: with_glitches(fly()),
    "signs of quaternions that flip": lambda: with_signs_that_flip(fly()),
    "a satellite receiver": lambda: with_gps(fly()),
}


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_log_is_read_without_a_word(name, tmp_path):
    assert not remarks(read_log(stored(tmp_path, RIGHT[name]()), MAPPING))


def test_a_right_log_in_pieces_and_on_another_grid_is_read(tmp_path):
    table = fly(seconds=20).to_pandas()
    table = table.drop(index=[*range(400, 440), *range(900, 905), 1300])
    path = stored(tmp_path, table)
    assert len(read_log(path, MAPPING).runs[0].begins) == 4
    resampled = read_log(path, {**MAPPING, "rate": 30, "max_gap": 0.05})
    assert resampled.time_step == pytest.approx(1 / 30)


def test_short_pieces_are_judged_together(tmp_path):
    flight = fly(seconds=14)
    table = flight.change(w=flight.w @ FRD).to_pandas()
    table = table[(table["t"] % 0.7) < 0.6]
    with pytest.raises(DataError, match="axes: ned for rate"):
        read_log(stored(tmp_path, table), MAPPING)


def test_euler_angles_near_gimbal_lock_and_their_signs(tmp_path):
    angles = ["roll", "pitch", "yaw"]
    euler = {"columns": angles, "kind": "euler", "unit": "rad", "order": "xyzw"}
    mapping = with_states(attitude=euler)
    table = tumble(seconds=9).to_pandas()
    turns = Rotation.from_quat(table[["qx", "qy", "qz", "qw"]].to_numpy())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scipy's, of the lock
        table[angles] = turns.as_euler("ZYX")[:, ::-1]
    assert table["pitch"].abs().max() > 1.5
    assert not remarks(read_log(stored(tmp_path, table), mapping))
    with pytest.raises(DataError, match=r"pitch of attitude.*scale: \[1, -1, 1\]"):
        read_log(stored(tmp_path, table.assign(pitch=-table["pitch"])), mapping)
    swapped = table.assign(roll=table["pitch"], pitch=table["roll"])
    with pytest.raises(DataError, match=r"columns: \[pitch, roll, yaw\] for attitude"):
        read_log(stored(tmp_path, swapped), mapping)


def test_a_body_that_is_carried_by_its_underside_is_a_finding(flight, tmp_path):
    upside_down = flight.change(q=of_frd(flight), w=flight.w @ FRD)
    (finding,) = remarks(read_log(stored(tmp_path, upside_down), MAPPING))
    assert finding.kind == "upside down"
    assert "on its back, or attitude is that of a body in FRD axes" in finding.text
    assert "columns: [qw, qz, qy, qx] and scale: [1, 1, -1, -1]" in finding.text


def test_a_short_lag_and_clocks_that_disagree_are_findings(flight, tmp_path):
    rates_late = flight.change(w=late(flight.w, 10))
    (finding,) = remarks(read_log(stored(tmp_path, rates_late), MAPPING))
    assert finding.kind == "late"
    assert "rate comes 0.1 s after attitude" in finding.text
    other_clock = flight.change(q=late(flight.q, 30), w=late(flight.w, 30))
    (finding,) = remarks(read_log(stored(tmp_path, other_clock), MAPPING))
    assert "attitude and rate come about 0.3 s after position" in finding.text


def test_what_nothing_explains_is_refused_with_its_numbers(flight, tmp_path):
    other = fly(seconds=14, seed=7)
    with pytest.raises(
        DataError, match=r"no single change .* explains it \(corr.*rate"
    ):
        read_log(stored(tmp_path, flight.change(w=other.w)), MAPPING)


def test_a_run_is_named_and_one_wrong_file_of_many_is_found(flight, tmp_path):
    right = stored(tmp_path, flight, "right")
    wrong = stored(tmp_path, flight.change(q=scalar_first(flight.q)), "wrong")
    with pytest.raises(DataError, match="run wrong: attitude is in the order wxyz"):
        read_log([right, wrong], MAPPING)


@pytest.mark.parametrize(
    ("mistake", "expected"),
    [
        ("quaternions with the scalar first", "order: wxyz"),
        ("rates FRD", "rate is in FLU axes, not in FRD: write axes: enu for rate"),
        ("a velocity NED", "axes: enu for velocity"),
        ("velocities in body axes", "frame: body for velocity"),
        ("rates in world axes", "frame: world for rate"),
        ("y of the velocity flipped", r"scale: \[1, -1, 1\] for velocity"),
        ("x and y of the rate swapped", r"columns: \[wy, wx, wz\] for rate"),
    ],
)
def test_a_mistake_in_a_log_that_is_in_ned_is_named(
    mistake, expected, flight, tmp_path
):
    ned = flight.change(
        p=flight.p @ NED, q=in_ned(flight), v=flight.v @ NED, w=flight.w @ FRD
    )
    spoil, _ = MISTAKES[mistake]
    with pytest.raises(DataError, match=expected) as refusal:
        read_log(stored(tmp_path, spoil(ned)), {**MAPPING, "frame": "ned"})
    assert "; and" not in str(refusal.value)


@pytest.mark.parametrize(
    ("mistake", "states"),
    [
        ("quaternions with the scalar first", {"attitude": {"order": "wxyz"}}),
        ("inverse quaternions", {"attitude": {"scale": [-1, -1, -1, 1]}}),
        ("rates FRD", {"rate": {"axes": "ned"}}),
        ("an attitude NED and FRD", {"attitude": {"axes": "ned"}}),
        (
            "an attitude FRD",
            {
                "attitude": {
                    "columns": ["qw", "qz", "qy", "qx"],
                    "scale": [1, 1, -1, -1],
                }
            },
        ),
        ("a velocity NED", {"velocity": {"axes": "ned"}}),
        (
            "x and y of the velocity swapped",
            {"velocity": {"columns": ["vy", "vx", "vz"]}},
        ),
        ("rates in world axes", {"rate": {"frame": "world"}}),
        ("one rate in degrees", {"rate": {"scale": [np.pi / 180, 1, 1]}}),
        ("an attitude 0.2 s late", {"attitude": {"delay": 0.2}}),
        (
            "velocities in body axes, FRD",
            {"velocity": {"frame": "body", "axes": "ned"}},
        ),
    ],
)
def test_what_is_advised_reads_the_log_as_it_was(mistake, states, flight, tmp_path):
    spoil, _ = MISTAKES[mistake]
    log = read_log(stored(tmp_path, spoil(flight)), with_states(**states))
    expected = read_log(stored(tmp_path, flight), MAPPING)
    rows = slice(50, 1300)
    difference = log.space.difference(
        log.runs[0].states[rows], expected.runs[0].states[rows]
    )
    np.testing.assert_allclose(difference, 0, atol=1e-9)
    assert not remarks(log)


def test_a_log_in_ned_and_frd_comes_out_in_enu_and_flu(flight, tmp_path):
    ned = flight.change(
        p=flight.p @ NED, q=in_ned(flight), v=flight.v @ NED, w=flight.w @ FRD
    )
    expected = read_log(stored(tmp_path, flight), MAPPING)
    log = read_log(stored(tmp_path, ned), {**MAPPING, "frame": "ned"})
    difference = log.space.difference(log.runs[0].states, expected.runs[0].states)
    np.testing.assert_allclose(difference, 0, atol=1e-9)
    assert log.space.groups[0].entries == ("py", "px", "pz")
    assert log.mapping.column_names("states")[:2] == (
        "py in other axes",
        "px in other axes",
    )
    body = ned.change(v=(ned.attitude.inv()).apply(ned.v))
    mapping = {**with_states(velocity={"frame": "body"}), "frame": "ned"}
    log = read_log(stored(tmp_path, body), mapping)
    difference = log.space.difference(log.runs[0].states, expected.runs[0].states)
    np.testing.assert_allclose(difference, 0, atol=1e-9)


def test_a_log_in_enu_that_is_said_to_be_in_ned_is_refused(flight, tmp_path):
    with pytest.raises(DataError, match="gravity says .* write frame: enu"):
        read_log(stored(tmp_path, flight), {**MAPPING, "frame": "ned"})


def px4_log(path, flight):
    """A ULog of one topic with the states of a flight."""
    names = list(flight.to_pandas().drop(columns="t"))
    fields = "".join(f"float {name};" for name in names)

    def message(kind, body):
        return struct.pack("<Hc", len(body), kind) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40))
    data += message(b"F", f"body:uint64_t timestamp;{fields}".encode())
    data += message(b"A", struct.pack("<BH", 0, 0) + b"body")
    for t, *row in flight.to_pandas().to_numpy():
        stamp = round(1e6 * (t + 1))
        body = struct.pack(f"<HQ{len(row)}f", 0, stamp, *row)
        data += message(b"D", body)
    path.write_bytes(data)
    return path


def test_a_px4_log_is_in_ned_unless_its_mapping_says_otherwise(flight, tmp_path):
    ned = flight.change(
        p=flight.p @ NED, q=in_ned(flight), v=flight.v @ NED, w=flight.w @ FRD
    )
    path = px4_log(tmp_path / "flight.ulg", ned)
    topics = {
        role: {
            name: {
                **(own if isinstance(own, dict) else {"columns": own}),
                "topic": "body",
            }
            for name, own in MAPPING[role].items()
        }
        for role in ("states", "inputs")
    }
    mapping = {"model": "rigid_body", **topics}
    log = read_log(path, mapping)
    assert log.mapping.axes == "ned"
    expected = read_log(stored(tmp_path, flight), MAPPING)
    difference = log.space.difference(log.runs[0].states, expected.runs[0].states)
    np.testing.assert_allclose(difference, 0, atol=1e-5)
    with pytest.raises(DataError, match="frame: ned"):
        read_log(path, {**mapping, "frame": "enu"})
    with pytest.raises(SettingError, match="frame.*enu or ned"):
        read_log([path, stored(tmp_path, flight)], mapping)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({**MAPPING, "frame": "nwu"}, "frame"),
        ({**MAPPING, "frame": "ned", "model": "none"}, "frame.*model: rigid_body"),
        (with_states(rate={"axes": "frd"}), "states.rate.axes"),
        (with_states(rate={"scale": [1, -1]}), "states.rate.scale.*3 numbers"),
        (with_states(rate={"delay": "late"}), "states.rate.delay"),
        (
            {**with_states(rate={"axes": "ned"}), "model": "none"},
            "states.rate.axes.*rigid_body",
        ),
    ],
)
def test_a_wrong_word_about_axes_is_named(content, expected):
    with pytest.raises(SettingError, match=expected):
        LogMapping.from_dict(yaml.safe_load(yaml.safe_dump(content)))


@pytest.fixture(scope="session")
def real_flights():
    """The ten flights of NanoBench, which are not part of this repository."""
    folder = os.environ.get("GPMPC_FLIGHTS")
    if not folder:
        pytest.skip("GPMPC_FLIGHTS names no folder with the flights of NanoBench")
    return sorted(Path(folder).glob("*.csv.gz"))


def test_no_real_flight_is_refused_and_mistakes_in_it_are(real_flights, tmp_path):
    airborne = {"keep": {"pz": [0.2, None]}, "max_gap": 0.045, "held": "use"}
    rates = {"columns": [f"w{axis}_vicon" for axis in "xyz"]}
    motors = {"motors": [f"motor_motor_m{i}" for i in (1, 2, 3, 4)]}
    mapping = {**with_states(rate=rates), **airborne, "inputs": motors}
    on_ground = {**mapping, "keep": {}, "rest": "use", "inputs": {}}
    assert len(real_flights) == 10
    for path in real_flights:
        stays = path.name.startswith("B7")
        log = read_log(path, on_ground if stays else mapping)
        assert not remarks(log)
        if stays:
            continue
        table = pandas.read_csv(path)
        spoiled = table.rename(columns={"qw": "qx", "qx": "qy", "qy": "qz", "qz": "qw"})
        with pytest.raises(DataError, match="order: wxyz for attitude"):
            read_log(stored(tmp_path, spoiled), mapping)
