"""What only an emulated rig knows of a view: its poses, its sharp picture, its surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError
from spikerig.dataset.rawtake import RawTake, TakenView
from spikerig.dataset.scene import Frame, Points, Pose, Trajectory, Truth, View
from spikerig.rigctl.ingest_times import Times
from spikerig.rigctl.sim.capture import rig_of
from spikerig.rigctl.sim.caster.light import stage_of
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.sim.emulate.world import World, world_of
from spikerig.rigctl.sim.rgb import encode
from spikerig.rigctl.sim.take import share_of, surface

KNOTS = 33  # of a view's path


@dataclass(frozen=True, slots=True)
class TrueView:
    """A view with its truth."""

    view: View
    light: NDArray[np.float32]
    at_ns: int
    trajectory: Trajectory


class TrueWorld:
    """The world of an emulated take, made again from what the rig told.

    Raises:
        DataError: the truth does not say what is needed.
    """

    def __init__(self, take: RawTake, times: Times, sessions: list[Mapping[str, Any]]) -> None:
        self.take, self.times, self.sessions = take, times, sessions
        wire = take.profile
        try:
            told = sessions[0]["world"]
            self.world: World = world_of(
                str(told["scene"]), int(told["views"]), (wire.width, wire.height), wire.rate_hz, VirtualHost(),
                int(told["seed"]) or None,
            )  # fmt: skip
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise DataError("the emulated rig's truth does not name its world", value=f"{error!r}") from error
        spec = self.world.spec
        self.camera, self.light_gain = self.world.camera, rig_of(spec).light_gain
        clock = ClockModel.identity()
        self.truth = Truth({}, {}, {}, clock, {}, spec.seed, "mid")
        self._points: list[Points] = []
        self._numbers = {name: k for k, name in enumerate(take.plan["viewpoints"])}

    def view(self, view: View, taken: TakenView) -> TrueView:
        """The view with true pose and path; one that is held out becomes its sharp picture, as the simulator does."""
        session = next((s for s in self.sessions if s["start_ns"] <= taken.start_ns <= s["end_ns"]), None)
        if session is None:
            raise DataError("no session of the emulated rig covers this view", value=view.name)
        frame, mid_ns = view.frame, view.mid_ns
        end = frame.start_ns + frame.exposure_ns + round(frame.row_ns * float(view.sensor_row.max()))
        at = np.unique(np.append(np.linspace(frame.start_ns, end, KNOTS).astype(np.int64), mid_ns))
        number = self._numbers[taken.name]
        poses = self.world.poses(number, self.times.true_from_rig(session, at))
        pose = poses[int(np.searchsorted(at, mid_ns))]
        light, path = self.world.sharp(pose), Trajectory(at, poses)
        view = replace(view, pose=Pose(pose), trajectory=path)
        if view.split == "test":
            sharp = Frame(encode(light), start_ns=mid_ns)
            view = replace(view, frame=sharp, spikes=None, trajectory=None)
        else:
            self._add_points(view, number)
        return TrueView(view, light, mid_ns, path)

    def points(self) -> Points:
        """The surface points of all training views so far."""
        parts = self._points or [Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "simulator")]
        return Points(np.concatenate([p.xyz for p in parts]), np.concatenate([p.rgb for p in parts]), "simulator")

    def _add_points(self, view: View, number: int) -> None:
        spec = self.world.spec
        views = len(self._numbers)
        depth = stage_of(spec.world).depth(self.camera, view.pose.cam_from_world)
        share = share_of(spec.cloud.count, number % views, views)
        self._points.append(surface(rig_of(spec), number, spec.cloud, max(share, 1), view, depth))
