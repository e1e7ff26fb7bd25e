"""Draws steps in space: where the vehicle is, where it should be, where it plans to go and how sure it is.

``RecordedSystem.pose`` names the states of position and attitude; what has none is 0. The tube of a plan is one
ellipsoid per stage, the 2-sigma surface of the predicted position. A viewer draws some thirty pictures a second, so no
more are written.

Viewers have their z axis pointing upwards: the frame ``display`` is the parent of the world frame, half a turn about x
away where that one's points downwards, and is the one to look from.
"""

from typing import Any

import numpy as np
from foxglove import Context, channels
from foxglove import messages as fg

from gpmpc.recording._encoding import StepCopy
from gpmpc.recording._messages import ATTITUDE, POSITION, RecordedSystem

Array = np.ndarray

DISPLAY, VEHICLE = "display", "vehicle"
_INTERVAL = 1 / 30  # [s]
_SIGMAS = 2.0  # radius of the tube in standard deviations
_TUBE, _LINE = fg.Color(r=0.0, g=0.45, b=0.7, a=0.18), fg.Color(r=0.0, g=0.45, b=0.7, a=0.9)
_ORIGIN = fg.Pose(position=fg.Vector3(), orientation=fg.Quaternion(w=1.0))


class Scene:
    """Logs the pictures of steps; nothing for states that are neither positions nor attitudes."""

    def __init__(self, context: Context, system: RecordedSystem):
        at = {axis: system.state_names.index(name) for axis, name in system.pose.items()}
        self._frame = system.frame
        self._display_turn = fg.Quaternion(x=1.0) if system.z_down else fg.Quaternion(w=1.0)
        self._position, self._attitude = ([at.get(axis, -1) for axis in axes] for axes in (POSITION, ATTITUDE))
        self._next = -np.inf if at else np.inf  # time of the next picture [s]
        self._frames = [channels.FrameTransformChannel(topic, context=context) for topic in ("/tf/display", "/tf")]
        self._poses = [channels.PoseInFrameChannel(topic, context=context) for topic in ("/pose", "/reference")]
        self._path = channels.PosesInFrameChannel("/plan/path", context=context)
        self._tube = channels.SceneUpdateChannel("/plan/tube", context=context)

    def log(self, copy: StepCopy, nanoseconds: int) -> None:
        """Logs the picture of a step, if one is due, at its time stamp [ns]."""
        if copy.step.time < self._next:
            return
        self._next = copy.step.time + _INTERVAL * (1 - 1e-6)  # a step of just the interval is drawn every time
        means = copy.plan[1] if copy.plan else np.zeros((0, len(copy.state)))
        states = np.vstack([copy.state, copy.reference, means])
        places = [fg.Vector3(x=x, y=y, z=z) for x, y, z in _selected(states, self._position).tolist()]
        turns = _quaternions(_from_angles(_selected(states, self._attitude)))
        poses = [fg.Pose(position=place, orientation=turn) for place, turn in zip(places, turns, strict=True)]
        at: Any = {"timestamp": fg.Timestamp(sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9)}
        frames = ((DISPLAY, self._frame, fg.Vector3(), self._display_turn),)
        frames += ((self._frame, VEHICLE, places[0], turns[0]),)
        for channel, (parent, child, place, turn) in zip(self._frames, frames, strict=True):
            names: Any = {"parent_frame_id": parent, "child_frame_id": child}
            channel.log(fg.FrameTransform(translation=place, rotation=turn, **names, **at), log_time=nanoseconds)
        at["frame_id"] = self._frame
        for channel, pose in zip(self._poses, poses, strict=False):
            channel.log(fg.PoseInFrame(pose=pose, **at), log_time=nanoseconds)
        if copy.plan:
            self._path.log(fg.PosesInFrame(poses=poses[2:], **at), log_time=nanoseconds)
            line = fg.LinePrimitive(
                type=fg.LinePrimitiveLineType.LineStrip,
                pose=_ORIGIN,
                thickness=2.0,
                scale_invariant=True,
                points=[fg.Point3(x=x, y=y, z=z) for x, y, z in _selected(means, self._position).tolist()],
                color=_LINE,
            )
            tube = self._ellipsoids(places[2:], copy.plan[2])
            entity = fg.SceneEntity(id="plan", spheres=tube, lines=[line], **at)
            self._tube.log(fg.SceneUpdate(entities=[entity]), log_time=nanoseconds)

    def _ellipsoids(self, places: list[fg.Vector3], covariances: Array) -> list[fg.SpherePrimitive]:
        """The 2-sigma ellipsoids of covariances (K, n, n), but those without extent."""
        spatial = _selected(_selected(covariances, self._position).mT, self._position)
        variances, directions = np.linalg.eigh(np.nan_to_num(spatial, posinf=0.0, neginf=0.0))
        directions[np.linalg.det(directions) < 0, :, 0] *= -1  # reflections are no rotations
        diameters = 2 * _SIGMAS * np.sqrt(np.maximum(variances, 0))
        return [
            fg.SpherePrimitive(
                pose=fg.Pose(position=place, orientation=turn), size=fg.Vector3(x=a, y=b, z=c), color=_TUBE
            )
            for place, turn, (a, b, c) in zip(
                places, _quaternions(_from_matrices(directions)), diameters.tolist(), strict=True
            )
            if a or b or c
        ]


def _selected(values: Array, entries: list[int]) -> Array:
    """Selects entries of the last axis; -1 stands for one that is 0."""
    return np.where(np.array(entries) < 0, 0.0, values[..., entries])


def _quaternions(numbers: Array) -> list[fg.Quaternion]:
    return [fg.Quaternion(x=x, y=y, z=z, w=w) for x, y, z, w in numbers.tolist()]


def _from_angles(angles: Array) -> Array:
    """Computes the quaternions x, y, z, w (K, 4) of Rz(yaw) Ry(pitch) Rx(roll) from roll, pitch, yaw (K, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T / 2), np.sin(angles.T / 2)
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    return np.stack([x, y, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy], axis=1)


def _from_matrices(R: Array) -> Array:
    """Computes the quaternions x, y, z, w (K, 4) of rotation matrices (K, 3, 3).

    They are the eigenvectors of the largest eigenvalue of a symmetric matrix (Bar-Itzhack, J. Guidance and Control 23,
    2000).
    """
    K = np.zeros((len(R), 4, 4))
    trace = R.trace(axis1=1, axis2=2)
    K[:, :3, :3] = R + R.mT - trace[:, None, None] * np.eye(3)
    K[:, 3, :3] = K[:, :3, 3] = np.stack([R[:, i, j] - R[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    K[:, 3, 3] = trace
    return np.linalg.eigh(K)[1][:, :, -1]
