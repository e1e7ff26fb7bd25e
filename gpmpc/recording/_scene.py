"""Draws steps in space: where the vehicle is, where it should be, where it plans to go and how sure it is.

An axis that no state is, is 0. The tube of a plan is one ellipsoid per stage, the 2-sigma surface of the predicted
position. A viewer draws some thirty pictures a second, so no more are written. Viewers have their z axis pointing
upwards: the frame ``display``, to look from, is half a turn about x away from a world whose z axis points downwards.
"""

from typing import Any

import numpy as np
from foxglove import Context, channels
from foxglove import messages as fg

from gpmpc.recording._messages import ATTITUDE, POSITION, RecordedSystem, StepCopy

Array = np.ndarray

DISPLAY = "display"
WORLD = "world"
VEHICLE = "vehicle"
_INTERVAL = 1 / 30  # [s]
_SIGMAS = 2.0  # radius of the tube in standard deviations
_TUBE = fg.Color(r=0.0, g=0.45, b=0.7, a=0.18)
_LINE = fg.Color(r=0.0, g=0.45, b=0.7, a=0.9)


class Scene:
    """Logs the pictures of steps; nothing for states that are neither positions nor attitudes."""

    def __init__(self, context: Context, system: RecordedSystem):
        at = {
            axis: system.state_names.index(name) for axis, name in system.pose.items()
        }
        self._display_turn = (
            fg.Quaternion(x=1.0) if system.z_down else fg.Quaternion(w=1.0)
        )
        self._position, self._attitude = (
            [at.get(axis, -1) for axis in axes] for axes in (POSITION, ATTITUDE)
        )
        self._next = -np.inf if at else np.inf  # time of the next picture [s]
        self._frames = [
            channels.FrameTransformChannel(topic, context=context)
            for topic in ("/tf/display", "/tf")
        ]
        self._poses = [
            channels.PoseInFrameChannel(topic, context=context)
            for topic in ("/pose", "/reference")
        ]
        self._path = channels.PosesInFrameChannel("/plan/path", context=context)
        self._tube = channels.SceneUpdateChannel("/plan/tube", context=context)

    def log(self, copy: StepCopy, nanoseconds: int) -> None:
        """Logs the picture of a step, if one is due, at its time stamp [ns]."""
        if copy.step.time < self._next:
            return
        from scipy.spatial.transform import Rotation  # not needed to read

        self._next = copy.step.time + _INTERVAL * (
            1 - 1e-6
        )  # a step of just the interval is drawn every time
        state = copy.arrays["state"]
        plan = copy.arrays.get("means", np.zeros((0, len(copy.arrays["state"]))))
        states = np.vstack([state, copy.arrays["reference"], plan])
        points = _selected(states, self._position).tolist()
        places = [fg.Vector3(x=x, y=y, z=z) for x, y, z in points]
        turns = _quaternions(
            Rotation.from_euler("ZYX", _selected(states, self._attitude)[:, ::-1])
        )
        poses = [
            fg.Pose(position=place, orientation=turn)
            for place, turn in zip(places, turns, strict=True)
        ]
        at: Any = {
            "timestamp": fg.Timestamp(
                sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9
            )
        }
        frames = (
            (DISPLAY, WORLD, fg.Vector3(), self._display_turn),
            (WORLD, VEHICLE, places[0], turns[0]),
        )
        for channel, (parent, child, place, turn) in zip(
            self._frames, frames, strict=True
        ):
            names: Any = {"parent_frame_id": parent, "child_frame_id": child}
            channel.log(
                fg.FrameTransform(translation=place, rotation=turn, **names, **at),
                log_time=nanoseconds,
            )
        at["frame_id"] = WORLD
        for channel, pose in zip(self._poses, poses, strict=False):
            channel.log(fg.PoseInFrame(pose=pose, **at), log_time=nanoseconds)
        if not len(plan):
            return
        self._path.log(fg.PosesInFrame(poses=poses[2:], **at), log_time=nanoseconds)
        spatial = _selected(
            _selected(copy.arrays["covariances"], self._position).mT, self._position
        )
        variances, directions = np.linalg.eigh(
            np.nan_to_num(spatial, posinf=0.0, neginf=0.0)
        )
        directions[
            np.linalg.det(directions) < 0, :, 0
        ] *= -1  # reflections are no rotations
        diameters = (2 * _SIGMAS * np.sqrt(np.maximum(variances, 0))).tolist()
        turned = _quaternions(Rotation.from_matrix(directions))
        tube = [
            fg.SpherePrimitive(
                pose=fg.Pose(position=p, orientation=q),
                size=fg.Vector3(x=a, y=b, z=c),
                color=_TUBE,
            )
            for p, q, (a, b, c) in zip(places[2:], turned, diameters, strict=True)
            if c  # the largest
        ]
        line = fg.LinePrimitive(
            type=fg.LinePrimitiveLineType.LineStrip,
            pose=fg.Pose(position=fg.Vector3(), orientation=fg.Quaternion(w=1.0)),
            thickness=2.0,
            scale_invariant=True,
            points=[fg.Point3(x=x, y=y, z=z) for x, y, z in points[2:]],
            color=_LINE,
        )
        entity = fg.SceneEntity(id="plan", spheres=tube, lines=[line], **at)
        self._tube.log(fg.SceneUpdate(entities=[entity]), log_time=nanoseconds)


def _selected(values: Array, entries: list[int]) -> Array:
    """Selects entries of the last axis; -1 stands for one that is 0."""
    return np.where(np.array(entries) < 0, 0.0, values[..., entries])


def _quaternions(turns: Any) -> list[fg.Quaternion]:
    return [
        fg.Quaternion(x=x, y=y, z=z, w=w) for x, y, z, w in turns.as_quat().tolist()
    ]
