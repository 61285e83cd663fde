"""Where the camera is: the orbit, the shake, the schedule."""

import numpy as np
import pytest
from hard_sim import small

from spikerig.rigctl.sim.capture import camera_of, view_path
from spikerig.rigctl.sim.orbit import Orbit, orbit_pose, target_depth
from spikerig.rigctl.sim.schedule import phase_ns, schedule, start_ns, track_phases
from spikerig.rigctl.sim.shake import path_px, rotation


def test_orbit_looks_at_its_target_upright() -> None:
    orbit = Orbit(views=7, arc_deg=180, start_deg=-90, radius=2, height=1.5, target=(0.3, -0.2, 0.5))
    for number in range(7):
        pose = orbit_pose(orbit, number)
        seen = pose @ np.array([0.3, -0.2, 0.5, 1])
        assert np.allclose(seen, [0, 0, target_depth(orbit)], atol=1e-12)
        above = pose @ np.array([0.3, -0.2, 0.6, 1])
        assert above[1] < 0  # up in the world is up in the picture: y points down
        assert abs(above[0]) < 1e-12
        assert np.linalg.det(pose[:, :3]) == pytest.approx(1)
    first, last = (orbit_pose(orbit, k) for k in (0, 6))
    ends = [-p[:, :3].T @ p[:, 3] for p in (first, last)]
    assert np.allclose(ends[0], [0.3, -2.2, 1.5])
    assert np.allclose(ends[1], [0.3, 1.8, 1.5])


def test_rotation_vectors() -> None:
    assert np.array_equal(rotation(np.zeros((1, 3)))[0], np.eye(3))
    quarter = rotation(np.array([[0, 0, np.pi / 2]]))[0]
    assert np.allclose(quarter @ [1, 0, 0], [0, 1, 0])
    vectors = np.random.default_rng(0).normal(size=(50, 3)) * np.logspace(-9, 0.3, 50)[:, None]
    R = rotation(vectors)
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    angle = np.linalg.norm(vectors, axis=1)
    assert np.allclose(np.trace(R, axis1=1, axis2=2), 1 + 2 * np.cos(angle), atol=1e-12)
    assert np.allclose(np.einsum("nij,nj->ni", R, vectors), vectors, atol=1e-12)


@pytest.mark.parametrize("span", [(6, 11), (0, 0), (2, 2)])
def test_path_length_is_as_asked(span: tuple[float, float]) -> None:
    spec = small(shake__path_px=list(span))
    lengths = []
    for number in range(4):
        path = view_path(spec, number)
        lengths.append(path_px(path, camera_of(spec), target_depth(spec.orbit)))
        assert np.allclose(path.poses(0.5)[0], orbit_pose(spec.orbit, number), atol=1e-14)
    assert span[0] - 1e-6 <= min(lengths)
    assert max(lengths) <= span[1] + 1e-6
    if span[1] > span[0]:
        assert len({round(v, 3) for v in lengths}) == 4


def test_path_is_smooth_through_the_margins() -> None:
    """A cubic spline: the third difference is bounded, no jump where pieces meet, nor beyond the exposure."""
    spec = small(exposure__margin_ticks=64)
    path = view_path(spec, 1)
    phase = np.linspace(-1.6, 2.6, 4201)
    second = np.diff(path.offset(phase), n=2, axis=0)
    assert np.abs(np.diff(second, axis=0)).max() < 0.02 * np.abs(second).max()
    assert np.abs(np.diff(path.offset(phase), axis=0)).max(1).min() > 0  # never at rest: no clamped end


def test_curvature_bends() -> None:
    def straightness(curvature: float) -> float:
        path = view_path(small(shake__curvature=curvature), 3)
        way = path.offset(np.linspace(0, 1, 50))[:, :2]
        return float(np.linalg.norm(way[-1] - way[0]) / np.linalg.norm(np.diff(way, axis=0), axis=1).sum())

    assert straightness(0) == pytest.approx(1, abs=1e-9)
    assert straightness(1.0) < 0.999


def test_shake_is_seeded_by_view() -> None:
    one, other = small(), small(seed=6)
    assert np.array_equal(view_path(one, 1).controls, view_path(small(), 1).controls)
    assert not np.allclose(view_path(one, 1).controls, view_path(one, 2).controls)
    assert not np.allclose(view_path(one, 1).controls, view_path(other, 1).controls)


def test_schedule_of_the_rig() -> None:
    plan = schedule(small(exposure={"sub_poses": 17}).exposure)
    inside = plan.knots[(plan.knots >= 0) & (plan.knots <= 320)]
    assert inside.tolist() == list(range(0, 321, 20))
    assert plan.knots[0] == -256
    assert plan.knots[-1] == 320 + 256
    assert np.diff(plan.knots).max() <= 20
    assert plan.label == 0.5
    assert np.array_equal(plan.phases, plan.knots / 320)
    assert schedule(small(exposure={"label": "first"}).exposure).label == 0


def test_schedule_of_the_paper() -> None:
    exposure = small(exposure={"protocol": "paper", "label": "first"}).exposure
    plan = schedule(exposure)
    assert plan.knots.tolist() == list(range(19))
    assert np.allclose(plan.phases, (np.arange(18) + 0.5) / 18)
    assert plan.label == plan.phases[0]
    phases = track_phases(plan)
    assert phases[0] == 0
    assert phases[-1] == 1
    assert plan.label in phases
    assert start_ns(exposure, 2) == 3_000_000_000
    assert phase_ns(exposure, 1.0) == 450_000


def test_one_sub_pose_stands_still() -> None:
    plan = schedule(small(exposure={"sub_poses": 1}).exposure)
    assert set(plan.phases) == {0.5}
