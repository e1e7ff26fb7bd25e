"""Problem: show a run in space: where the vehicle is, where it should be, where it plans to go and how sure it is.

Position and attitude are recognised by the states' names: x, y, z (one that is missing is 0) and the angles phi, theta,
psi (roll, pitch, yaw [rad], applied as Rz(psi) Ry(theta) Rx(phi)). The tube of a plan is one ellipsoid per stage, the
2-sigma surface of the predicted position. A viewer draws some thirty pictures a second, so no more are written.

The plants of this package have their z axis pointing downwards, viewers upwards: the frame ``display`` is the parent of
the world frame, half a turn about x away, and is the one to look from.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from gpmpc.recording.wire import PackedStep

LOG = "/log"
CLASSES = {
    "/pose": PoseInFrame,
    "/reference": PoseInFrame,
    "/plan/path": PosesInFrame,
    "/plan/tube": SceneUpdate,
    "/tf": FrameTransform,
    "/tf/display": FrameTransform,
}
INTERVAL = 1 / 30  # [s]
DISPLAY = "display"
VEHICLE = "vehicle"
SIGMAS = 2.0  # radius of the tube in standard deviations
POSITION, ATTITUDE = ("x", "y", "z"), ("phi", "theta", "psi")
_TUBE, _LINE = Color(r=0.12, g=0.45, b=0.85, a=0.18), Color(r=0.12, g=0.45, b=0.85, a=0.9)


class Scene:
    """Draws steps.

    Args:
        state_names: Names of the n states.
        frame: Name of the frame that positions are in.
        z_down: Whether the frame's z axis points downwards.
    """

    def __init__(self, state_names: Sequence[str], frame: str, z_down: bool):
        self._frame, self._z_down = frame, z_down
        self._position = [(axis, state_names.index(name)) for axis, name in enumerate(POSITION) if name in state_names]
        has_attitude = all(name in state_names for name in ATTITUDE)
        self._attitude = [state_names.index(name) for name in ATTITUDE] if has_attitude else []
        self._next = -np.inf  # time of the next picture [s]

    @property
    def topics(self) -> tuple[str, ...]:
        """What ``draw`` writes: nothing for states that are neither positions nor attitudes."""
        return tuple(CLASSES) if self._position or self._attitude else ()

    def draw(self, step: PackedStep, stamp: Timestamp) -> Iterator[tuple[str, Any]]:
        """Topics and messages of a step; none before a picture is due."""
        if not self.topics or step.time < self._next:
            return
        self._next = step.time + INTERVAL * (1 - 1e-6)  # a step of just the interval is drawn every time
        in_frame = {"timestamp": stamp, "frame_id": self._frame}
        here = self._pose(step.state)
        turned = Quaternion(x=1.0) if self._z_down else Quaternion(w=1.0)
        yield (
            "/tf/display",
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=DISPLAY,
                child_frame_id=self._frame,
                translation=Vector3(),
                rotation=turned,
            ),
        )
        yield (
            "/tf",
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=self._frame,
                child_frame_id=VEHICLE,
                translation=here.position,
                rotation=here.orientation,
            ),
        )
        yield "/pose", PoseInFrame(pose=here, **in_frame)
        yield "/reference", PoseInFrame(pose=self._pose(step.reference), **in_frame)
        yield "/plan/path", PosesInFrame(poses=[self._pose(mean) for mean in step.means], **in_frame)
        yield "/plan/tube", self._tube(step, stamp)

    def _pose(self, state: np.ndarray) -> Pose:
        roll, pitch, yaw = (state[i] for i in self._attitude) if self._attitude else (0.0, 0.0, 0.0)
        return Pose(position=Vector3(**self._coordinates(state)), orientation=_from_angles(roll, pitch, yaw))

    def _coordinates(self, state: np.ndarray) -> dict[str, float]:
        return {POSITION[axis]: float(state[i]) for axis, i in self._position}

    def _tube(self, step: PackedStep, stamp: Timestamp) -> SceneUpdate:
        axes, indices = [axis for axis, _ in self._position], [i for _, i in self._position]
        covariances = np.zeros((len(step.means), 3, 3))
        (rows, columns), (from_rows, from_columns) = np.ix_(axes, axes), np.ix_(indices, indices)
        covariances[:, rows, columns] = step.covariances[:, from_rows, from_columns]
        spheres = []
        if axes and np.isfinite(covariances).all() and covariances.any():
            variances, directions = np.linalg.eigh(covariances)
            directions[np.linalg.det(directions) < 0, :, 0] *= -1  # reflections are no rotations
            diameters = 2 * SIGMAS * np.sqrt(np.maximum(variances, 0))
            for mean, diameter, turn in zip(step.means, diameters.tolist(), directions, strict=True):
                pose = Pose(position=Vector3(**self._coordinates(mean)), orientation=_from_matrix(turn))
                size = Vector3(x=diameter[0], y=diameter[1], z=diameter[2])
                spheres.append(SpherePrimitive(pose=pose, size=size, color=_TUBE))
        points = [Point3(**self._coordinates(mean)) for mean in step.means]
        line = LinePrimitive(
            type=LinePrimitive.LINE_STRIP,
            pose=Pose(position=Vector3(), orientation=Quaternion(w=1.0)),
            thickness=2.0,
            scale_invariant=True,
            points=points,
            color=_LINE,
        )
        entity = SceneEntity(timestamp=stamp, frame_id=self._frame, id="plan", spheres=spheres, lines=[line])
        return SceneUpdate(entities=[entity])


def failure_log(step: PackedStep, stamp: Timestamp) -> Log | None:
    """What went wrong at a step; None if nothing did."""
    if step.status.solved and not step.failed:
        return None
    policy = "; the policy for failures chose the input" if step.failed else ""
    message = f"step {step.k}: {step.status.name}: {step.status.advice}{policy}"
    return Log(timestamp=stamp, level=Log.ERROR if step.failed else Log.WARNING, name="gpmpc", message=message)


def _from_angles(roll: float, pitch: float, yaw: float) -> Quaternion:
    """The rotation Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.array([roll, pitch, yaw]) / 2) for f in (np.cos, np.sin))
    return Quaternion(
        w=cr * cp * cy + sr * sp * sy,
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
    )


def _from_matrix(R: np.ndarray) -> Quaternion:
    """The quaternion of a rotation matrix, from its largest component (Shepperd, J. Guidance and Control 1, 1978)."""
    squares = 1 + np.array([R.trace(), *(2 * R.diagonal() - R.trace())])  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    i = int(np.argmax(squares))
    products = np.array(  # 4 q_i q_j off the diagonal
        [
            [squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], squares[1], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], squares[2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], squares[3]],
        ]
    )
    w, x, y, z = products[i] / (2 * np.sqrt(squares[i]))
    return Quaternion(w=w, x=x, y=y, z=z)
