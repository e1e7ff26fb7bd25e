"""Draws steps in space: where the vehicle is, where it should be, where it plans to go and how sure it is.

Position and attitude are recognised by the states' names: x, y, z (one that is missing is 0) and the angles phi, theta,
psi (roll, pitch, yaw [rad], applied as Rz(psi) Ry(theta) Rx(phi)). The tube of a plan is one ellipsoid per stage, the
2-sigma surface of the predicted position. A viewer draws some thirty pictures a second, so no more are written.

The plants of this package have their z axis pointing downwards, viewers upwards: the frame ``display`` is the parent of
the world frame, half a turn about x away, and is the one to look from.
"""

from collections.abc import Sequence

import numpy as np
from foxglove import Context, channels, messages
from foxglove.messages import Pose, Quaternion, Timestamp, Vector3

from gpmpc.recording._steps import Kept

Array = np.ndarray
Numbers = list[float]

DISPLAY, VEHICLE = "display", "vehicle"
POSITION, ATTITUDE = ("x", "y", "z"), ("phi", "theta", "psi")
_INTERVAL = 1 / 30  # [s]
_SIGMAS = 2.0  # radius of the tube in standard deviations
_TUBE, _LINE = messages.Color(r=0.12, g=0.45, b=0.85, a=0.18), messages.Color(r=0.12, g=0.45, b=0.85, a=0.9)
_LEVEL = [1.0, 0.0, 0.0, 0.0]  # the quaternion w, x, y, z of no rotation


class Scene:
    """Logs the pictures of steps; nothing for states that are neither positions nor attitudes.

    Args:
        context: Of the recording.
        states: Names of the n states.
        frame: Name of the frame that positions are in.
        z_down: Whether the frame's z axis points downwards.
    """

    def __init__(self, context: Context, states: Sequence[str], frame: str, z_down: bool):
        self._frame, self._display_turn = frame, [0.0, 1.0, 0.0, 0.0] if z_down else _LEVEL
        self._axes = [axis for axis, name in enumerate(POSITION) if name in states]
        self._position = [states.index(POSITION[axis]) for axis in self._axes]
        self._attitude = [states.index(name) for name in ATTITUDE] if set(ATTITUDE) <= set(states) else []
        self._next = -np.inf if self._axes or self._attitude else np.inf  # time of the next picture [s]
        self._frames = [channels.FrameTransformChannel(topic, context=context) for topic in ("/tf/display", "/tf")]
        self._poses = [channels.PoseInFrameChannel(topic, context=context) for topic in ("/pose", "/reference")]
        self._path = channels.PosesInFrameChannel("/plan/path", context=context)
        self._tube = channels.SceneUpdateChannel("/plan/tube", context=context)

    def log(self, kept: Sequence[Kept], stamps: Sequence[int]) -> None:
        """Logs the pictures of steps, at their time stamps [ns], that are due."""
        due = []
        for step, nanoseconds in zip(kept, stamps, strict=True):
            if step.step.time >= self._next:
                self._next = step.step.time + _INTERVAL * (1 - 1e-6)  # a step of just the interval is drawn every time
                due.append((step, nanoseconds))
        if not due:
            return
        # The numbers of all pictures at once: a call of NumPy costs more than they do.
        plans = [step.plan or (None, np.zeros((0, len(step.state))), None) for step, _ in due]
        states = [np.vstack([step.state, step.reference, plan[1]]) for (step, _), plan in zip(due, plans, strict=True)]
        points, turns = self._places(np.concatenate(states))
        covariances = [plan[2] for plan in plans if plan[2] is not None]
        ellipsoids = self._ellipsoids(np.concatenate(covariances)) if covariances else []
        for (step, nanoseconds), rows in zip(due, states, strict=True):
            count = len(rows)
            self._log_vehicle(points[:2], turns[:2], nanoseconds)
            if step.plan is not None:
                self._log_plan(points[2:count], turns[2:count], ellipsoids[: count - 2], nanoseconds)
                ellipsoids = ellipsoids[count - 2 :]
            points, turns = points[count:], turns[count:]

    def _places(self, states: Array) -> tuple[list[Numbers], list[Numbers]]:
        """Computes the positions and the quaternions of states (K, n)."""
        positions = np.zeros((len(states), 3))
        positions[:, self._axes] = states[:, self._position]
        turns = _from_angles(states[:, self._attitude]) if self._attitude else np.tile(_LEVEL, (len(states), 1))
        return positions.tolist(), turns.tolist()

    def _ellipsoids(self, covariances: Array) -> list[tuple[Numbers, Numbers]]:
        """Computes the quaternions and the diameters of the 2-sigma ellipsoids of covariances (K, n, n)."""
        spatial = np.zeros((len(covariances), 3, 3))
        rows, columns = np.array(self._axes, int)[:, None], self._axes
        spatial[:, rows, columns] = covariances[:, np.array(self._position, int)[:, None], self._position]
        variances, directions = np.linalg.eigh(np.nan_to_num(spatial, posinf=0.0, neginf=0.0))
        directions[np.linalg.det(directions) < 0, :, 0] *= -1  # reflections are no rotations
        diameters = 2 * _SIGMAS * np.sqrt(np.maximum(variances, 0))
        return list(zip(_from_matrices(directions).tolist(), diameters.tolist(), strict=True))

    def _log_vehicle(self, points: Sequence[Numbers], turns: Sequence[Numbers], nanoseconds: int) -> None:
        frames = ((DISPLAY, self._frame, [0.0, 0.0, 0.0], self._display_turn),)
        frames += ((self._frame, VEHICLE, points[0], turns[0]),)
        for channel, (parent, child, point, turn) in zip(self._frames, frames, strict=True):
            transform = messages.FrameTransform(
                timestamp=_stamp(nanoseconds),
                parent_frame_id=parent,
                child_frame_id=child,
                translation=_vector(point),
                rotation=_quaternion(turn),
            )
            channel.log(transform, log_time=nanoseconds)
        for channel, point, turn in zip(self._poses, points, turns, strict=True):
            pose = messages.PoseInFrame(timestamp=_stamp(nanoseconds), frame_id=self._frame, pose=_pose(point, turn))
            channel.log(pose, log_time=nanoseconds)

    def _log_plan(
        self,
        points: Sequence[Numbers],
        turns: Sequence[Numbers],
        ellipsoids: Sequence[tuple[Numbers, Numbers]],
        nanoseconds: int,
    ) -> None:
        at = {"timestamp": _stamp(nanoseconds), "frame_id": self._frame}
        poses = [_pose(point, turn) for point, turn in zip(points, turns, strict=True)]
        self._path.log(messages.PosesInFrame(poses=poses, **at), log_time=nanoseconds)
        spheres = [
            messages.SpherePrimitive(pose=_pose(point, turn), size=_vector(diameters), color=_TUBE)
            for point, (turn, diameters) in zip(points, ellipsoids, strict=True)
            if any(diameters)
        ]
        line = messages.LinePrimitive(
            type=messages.LinePrimitiveLineType.LineStrip,
            pose=_pose([0.0, 0.0, 0.0], _LEVEL),
            thickness=2.0,
            scale_invariant=True,
            points=[messages.Point3(x=x, y=y, z=z) for x, y, z in points],
            color=_LINE,
        )
        entity = messages.SceneEntity(id="plan", spheres=spheres, lines=[line], **at)
        self._tube.log(messages.SceneUpdate(entities=[entity]), log_time=nanoseconds)


def _stamp(nanoseconds: int) -> Timestamp:
    return Timestamp(sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9)


def _vector(point: Numbers) -> Vector3:
    x, y, z = point
    return Vector3(x=x, y=y, z=z)


def _quaternion(turn: Numbers) -> Quaternion:
    w, x, y, z = turn
    return Quaternion(x=x, y=y, z=z, w=w)


def _pose(point: Numbers, turn: Numbers) -> Pose:
    return Pose(position=_vector(point), orientation=_quaternion(turn))


def _from_angles(angles: Array) -> Array:
    """Computes the quaternions w, x, y, z (K, 4) of the rotations Rz(yaw) Ry(pitch) Rx(roll) of angles (K, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T / 2), np.sin(angles.T / 2)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return np.stack([w, x, y, z], axis=1)


def _from_matrices(R: Array) -> Array:
    """Computes the quaternions w, x, y, z (K, 4) of rotation matrices (K, 3, 3).

    They are the eigenvectors of the largest eigenvalue of a symmetric matrix (Bar-Itzhack, J. Guidance and Control 23,
    2000).
    """
    K = np.zeros((len(R), 4, 4))
    skew = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    trace = R.trace(axis1=1, axis2=2)
    K[:, 0, 0], K[:, 0, 1:], K[:, 1:, 0] = trace, skew, skew
    K[:, 1:, 1:] = R + R.transpose(0, 2, 1) - trace[:, None, None] * np.eye(3)
    return np.linalg.eigh(K)[1][:, :, -1]
