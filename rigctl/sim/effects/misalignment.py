"""Misalignment: the RGB camera looks from elsewhere and elsewhere to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.arms import in_views, moved
from spikerig.rigctl.sim.caster.world import Vec3
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits
from spikerig.rigctl.sim.warp import plane_map, resampler

CAST = 1.6  # pictures cast anew differ by more than redrawn, softened ones: fine detail falls elsewhere


@dataclass(frozen=True, slots=True)
class Misalignment:
    """Points of the spike camera's frame are R x + t in the RGB camera's, R = Rz Ry Rx.

    With an analytic world the RGB arm's pictures are cast from its own pose: parallax, occlusion and all. Pictures from
    a folder, which know no geometry, are turned by a homography; a translation of them is refused. Poses and labels of
    views stay the spike camera's; the RGB picture is stored as its camera saw it.

    Args:
        rotation_deg: about x (right), y (down) and z (ahead).
        translation: of the RGB camera's frame.
    """

    rotation_deg: Vec3 = limits((0.1, -0.15, 0.1), -45, 45, "degrees")
    translation: Vec3 = limits((0.0, 0.0, 0.0), -1e6, 1e6, "world units")

    name: ClassVar[str] = "misalignment"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "rigid motion of a camera; the defaults stand for a rig aligned by hand to a few pixels"
    vanishes: ClassVar[str] = "rotation_deg = translation = 0"
    cost_ns: ClassVar[float] = 600.0

    @property
    def absent(self) -> bool:
        """Whether both cameras see the same."""
        return not any(self.rotation_deg) and not any(self.translation)

    @property
    def rgb_from_spike(self) -> NDArray[np.float64]:
        """float64[3,4], rotation | translation."""
        (cx, cy, cz), (sx, sy, sz) = (f(np.radians(self.rotation_deg)) for f in (np.cos, np.sin))
        rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.column_stack([rz @ ry @ rx, self.translation])

    def rgb_poses(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """The RGB camera's poses cam_from_world [n,3,4] where the spike camera's are `poses`."""
        R, t = self.rgb_from_spike[:, :3], self.rgb_from_spike[:, 3:]
        return np.concatenate([R @ poses[:, :, :3], R @ poses[:, :, 3:] + t], axis=2)

    def spike_from_rgb(self, K: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
        """The homography float64[3,3] from RGB to spike pixels of a plane that faces the spike camera."""
        H = self.rgb_from_spike[:, :3].copy()
        H[:, 2] += np.array(self.translation) / depth
        return K @ np.linalg.inv(H) @ np.linalg.inv(K)

    def begin(self, site: Site) -> Hooks:
        """Nothing where the arm was cast from its own pose; else a homography.

        Raises:
            UsageError: a translation of pictures without geometry, or no camera is known.
        """
        if site.own_arm or self.absent:
            return Hooks()
        if any(self.translation):
            raise UsageError(
                "pictures alone cannot be seen from elsewhere: a shifted camera needs the depth behind every pixel",
                value=f"misalignment.translation = {list(self.translation)}",
                expected="a rotation only, or a scene of the analytic world",
                next="render the RGB camera's own pictures, or set translation = [0, 0, 0]",
            )
        if site.camera is None:
            raise UsageError("misalignment needs the camera: how many pixels a degree is")
        redraw = resampler(site.height, site.width, plane_map(self.spike_from_rgb(site.camera.K, np.inf)))
        return Hooks(rgb_optics=redraw)

    def magnitude(self, facts: Facts) -> Bound:
        """The picture's change as a plane at the nearest and at the median depth would show it."""
        height, width = facts.size
        f = facts.focal_px
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
        shift = [f * float(np.linalg.norm(self.translation[:2])) / z for z in facts.depth]
        if self.absent:
            return Bound(0.0, 0.0, "the arms agree")
        depths = set(facts.depth) if any(self.translation) else {np.inf}
        maps = [plane_map(self.spike_from_rgb(K, depth)) for depth in depths]
        _, dn = moved(facts, "rgb", [resampler(height, width, one) for one in maps])
        turn = f * np.tan(np.radians(np.hypot(*self.rotation_deg[:2])))
        words = (
            f"turned {turn:.3g} px and {self.rotation_deg[2]:g} degrees, parallax {shift[1]:.3g} to {shift[0]:.3g} px"
        )
        return Bound(0.0, CAST * dn, f"{words}; {CAST:g} x {in_views(facts)}")
