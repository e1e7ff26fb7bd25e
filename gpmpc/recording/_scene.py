"""Draws steps in space: the vehicle, its reference, its plan and how sure that is.

An axis that no state is, is 0. The tube of a plan is one ellipsoid per stage, the
2-sigma surface of the predicted position. A viewer draws some thirty pictures a second,
so no more are written. Viewers have their z axis pointing upwards: the frame
``display``, to look from, is half a turn about x away from a world whose z axis points
downwards.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from foxglove import Context, channels
from foxglove import messages as fg

from gpmpc.recording._encoding import StepCopy
from gpmpc.recording._system import ATTITUDE, POSITION, RecordedSystem

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = np.ndarray

DISPLAY = "display"
WORLD = "world"
VEHICLE = "vehicle"
_INTERVAL = 1 / 30  # [s]
_SIGMAS = 2.0  # radius of the tube in standard deviations
_TUBE = fg.Color(r=0.0, g=0.45, b=0.7, a=0.18)
_LINE = fg.Color(r=0.0, g=0.45, b=0.7, a=0.9)


class _Moment(NamedTuple):
    """The time of a picture."""

    nanoseconds: int

    @property
    def timestamp(self) -> fg.Timestamp:
        return fg.Timestamp(
            sec=self.nanoseconds // 10**9, nsec=self.nanoseconds % 10**9
        )


class _Pose(NamedTuple):
    """A place and an attitude in the world."""

    position: fg.Vector3
    orientation: fg.Quaternion

    def message(self) -> fg.Pose:
        return fg.Pose(position=self.position, orientation=self.orientation)


class Scene:
    """Logs pictures of steps whose states are positions or attitudes."""

    def __init__(self, context: Context, system: RecordedSystem):
        columns = {
            axis: system.state_names.index(name) for axis, name in system.pose.items()
        }
        self._position = [columns.get(axis, -1) for axis in POSITION]
        self._attitude = [columns.get(axis, -1) for axis in ATTITUDE]
        self._display_turn = fg.Quaternion(w=1.0)
        if system.z_down:
            self._display_turn = fg.Quaternion(x=1.0)
        self._next_time = -np.inf if columns else np.inf  # of the next picture [s]
        self._display_frame = channels.FrameTransformChannel(
            "/tf/display", context=context
        )
        self._vehicle_frame = channels.FrameTransformChannel("/tf", context=context)
        self._pose = channels.PoseInFrameChannel("/pose", context=context)
        self._reference = channels.PoseInFrameChannel("/reference", context=context)
        self._path = channels.PosesInFrameChannel("/plan/path", context=context)
        self._tube = channels.SceneUpdateChannel("/plan/tube", context=context)

    def log(self, copy: StepCopy, nanoseconds: int) -> None:
        """Logs the picture of a step, if one is due, at its time stamp [ns]."""
        if copy.step.time < self._next_time:
            return
        # A step of just the interval is drawn every time.
        self._next_time = copy.step.time + _INTERVAL * (1 - 1e-6)
        moment = _Moment(nanoseconds)
        pose, reference = self._poses(
            np.stack([copy.arrays["state"], copy.arrays["reference"]])
        )
        self._log_frames(pose, moment)
        for channel, drawn in ((self._pose, pose), (self._reference, reference)):
            in_frame = fg.PoseInFrame(
                pose=drawn.message(), frame_id=WORLD, timestamp=moment.timestamp
            )
            channel.log(in_frame, log_time=nanoseconds)
        if "means" in copy.arrays:
            self._log_plan(copy.arrays["means"], copy.arrays["covariances"], moment)

    def _log_frames(self, pose: _Pose, moment: _Moment) -> None:
        """Logs where the frames of the world and of the vehicle are."""
        world_in_display = fg.FrameTransform(
            parent_frame_id=DISPLAY,
            child_frame_id=WORLD,
            translation=fg.Vector3(),
            rotation=self._display_turn,
            timestamp=moment.timestamp,
        )
        vehicle_in_world = fg.FrameTransform(
            parent_frame_id=WORLD,
            child_frame_id=VEHICLE,
            translation=pose.position,
            rotation=pose.orientation,
            timestamp=moment.timestamp,
        )
        self._display_frame.log(world_in_display, log_time=moment.nanoseconds)
        self._vehicle_frame.log(vehicle_in_world, log_time=moment.nanoseconds)

    def _log_plan(self, means: Array, covariances: Array, moment: _Moment) -> None:
        """Logs the path and the tube of a plan (H + 1, n)."""
        path = fg.PosesInFrame(
            poses=[pose.message() for pose in self._poses(means)],
            frame_id=WORLD,
            timestamp=moment.timestamp,
        )
        self._path.log(path, log_time=moment.nanoseconds)
        points = _selected(means, self._position)
        columns = _selected(covariances, self._position)
        spatial = _selected(columns.mT, self._position)  # (H + 1, 3, 3)
        entity = fg.SceneEntity(
            id="plan",
            spheres=_tube(points, spatial),
            lines=[_line(points)],
            frame_id=WORLD,
            timestamp=moment.timestamp,
        )
        update = fg.SceneUpdate(entities=[entity])
        self._tube.log(update, log_time=moment.nanoseconds)

    def _poses(self, states: Array) -> list[_Pose]:
        """Returns the poses of states (K, n)."""
        from scipy.spatial.transform import Rotation  # not needed to read

        angles = _selected(states, self._attitude)
        turns = Rotation.from_euler("ZYX", angles[:, ::-1])
        points = _selected(states, self._position).tolist()
        return [
            _Pose(position=fg.Vector3(x=x, y=y, z=z), orientation=turn)
            for (x, y, z), turn in zip(points, _quaternions(turns), strict=True)
        ]


def _tube(points: Array, covariances: Array) -> list[fg.SpherePrimitive]:
    """Returns the ellipsoids of positions (K, 3) with covariances (K, 3, 3)."""
    from scipy.spatial.transform import Rotation

    finite = np.nan_to_num(covariances, posinf=0.0, neginf=0.0)
    variances, directions = np.linalg.eigh(finite)
    # Reflections are no rotations.
    directions[np.linalg.det(directions) < 0, :, 0] *= -1
    diameters = (2 * _SIGMAS * np.sqrt(np.maximum(variances, 0))).tolist()
    turns = _quaternions(Rotation.from_matrix(directions))
    spheres = []
    for (x, y, z), turn, size in zip(points.tolist(), turns, diameters, strict=True):
        if not size[2]:  # the largest
            continue
        pose = fg.Pose(position=fg.Vector3(x=x, y=y, z=z), orientation=turn)
        diameter = fg.Vector3(x=size[0], y=size[1], z=size[2])
        spheres.append(fg.SpherePrimitive(pose=pose, size=diameter, color=_TUBE))
    return spheres


def _line(points: Array) -> fg.LinePrimitive:
    """Returns the line through positions (K, 3)."""
    return fg.LinePrimitive(
        type=fg.LinePrimitiveLineType.LineStrip,
        pose=fg.Pose(position=fg.Vector3(), orientation=fg.Quaternion(w=1.0)),
        thickness=2.0,
        scale_invariant=True,
        points=[fg.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()],
        color=_LINE,
    )


def _selected(values: Array, entries: Sequence[int]) -> Array:
    """Selects entries of the last axis; -1 stands for one that is 0."""
    return np.where(np.array(entries) < 0, 0.0, values[..., list(entries)])


def _quaternions(turns: "Rotation") -> list[fg.Quaternion]:
    return [
        fg.Quaternion(x=x, y=y, z=z, w=w) for x, y, z, w in turns.as_quat().tolist()
    ]
