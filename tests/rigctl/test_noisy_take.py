"""An emulated rig whose sensors are not perfect: noise, fixed patterns, dark current; the road holds all the same."""

from pathlib import Path

import numpy as np
import pytest
from emulated_takes import led_clocks, plan_of, rig_of, take

from spikerig.dataset.errors import UsageError
from spikerig.dataset.rawtake import open_take
from spikerig.dataset.store import open_scene
from spikerig.rigctl.ingest import ingest
from spikerig.rigctl.ingest_times import clip_number, read_truth
from spikerig.rigctl.sim.emulate.sensors import Sensors, effects_of
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.sim.emulate.world import Ticker, world_of

LED = {"period_ms": 410.0, "spike": [41.0, 30.0], "rgb": [20.0, 13.0]}
NOISE = [
    {"name": "shot_noise", "threshold_e": 200.0}, {"name": "threshold_fpn", "sd": 0.03},
    {"name": "dark_current", "rate": 0.01}, {"name": "comparator_noise", "sd": 0.02},
    {"name": "rgb_noise", "full_well_e": 4000.0}, {"name": "read_noise"},
]  # fmt: skip


def ticker(effects: list, seed: int = 0) -> Ticker:
    host = VirtualHost(10**12)
    world = world_of("demo", 3, (64, 48), 20_000.0, host, 7)
    if effects:
        world.sensors = Sensors(effects_of(effects, world.spec, "test"), world.camera, 20_000.0, seed)
    made = Ticker(world)
    made.tick_ns = lambda tick: 10**12 + tick * 50_000
    return made


def test_a_noisy_take_is_ingested_and_right_in_time(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    take(folder, plan_of(viewpoints=2, seconds=0.7, sync={"mode": "optical"}, led=LED), effects=NOISE)
    raw = open_take(folder)
    truth = read_truth(raw)
    assert truth[0]["spec"]["effects"] == NOISE
    told = ingest(folder, tmp_path / "s.h5")
    assert (told["views"], told["left_out"], told["panel_unread"]) == (2, {}, {})
    assert told["rgb_times"] == {"sights": 2}
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    times, _, _ = led_clocks(folder)
    for taken, view in zip(raw.views(), scene.views, strict=True):
        (row,) = [r for r in truth[0]["rgb"] if r["event"] == "clip" and r["number"] == clip_number(taken.clips[0])]
        off = times.rig_from_true(truth[0], np.array(row["true_ns"])) - view.frame.start_ns
        assert np.abs(off).min() < 300_000


def test_noise_is_in_the_spikes_and_nothing_without_it() -> None:
    clean, noisy, again = ticker([]), ticker(NOISE), ticker(NOISE)
    plain = np.concatenate([clean(t, t + 64) for t in range(0, 512, 64)])
    rough = np.concatenate([noisy(t, t + 64) for t in range(0, 512, 64)])
    np.testing.assert_array_equal(rough[:128], np.concatenate([again(0, 64), again(64, 128)]))
    assert (plain != rough).mean() > 0.05
    counts = [np.unpackbits(b, axis=2, bitorder="little").sum(0).astype(float) for b in (plain, rough)]
    assert counts[1].mean() == pytest.approx(counts[0].mean() + 0.01 * 512, rel=0.03)  # the dark current
    assert np.std((counts[1] - 5.12) / np.maximum(counts[0], 1)) > 0.02  # the fixed pattern


def test_draws_go_on_from_block_to_block() -> None:
    strong = [{"name": "shot_noise", "threshold_e": 4.0}]
    clean, noisy = ticker([]), ticker(strong)
    off = []
    for t in range(0, 256, 64):
        plain, rough = (np.unpackbits(made(t, t + 64), axis=2, bitorder="little").sum(0) for made in (clean, noisy))
        off.append((rough.astype(float) - plain).ravel())
    assert off[0].std() > 1
    assert max(abs(np.corrcoef(off[k], off[k + 1])[0, 1]) for k in range(3)) < 0.4
    sensors = noisy.world.sensors
    assert sensors is not None
    light, charge = np.full((64, 200), 0.4, np.float32), np.full(200, 1 << 31, np.uint32)
    first, second, again = (sensors.fire_rows(light, at, charge)[0] for at in (0, 64, 0))
    np.testing.assert_array_equal(first, again)
    assert (first != second).mean() > 0.3


def test_the_rgb_camera_is_noisy_too() -> None:
    frames = [t.world.frame(10**12, 4_000_000, 0.0).astype(float) for t in (ticker([]), ticker(NOISE))]
    off = frames[1] - frames[0]
    assert 0.5 < off.std() < 20
    assert abs(off.mean()) < 2


@pytest.mark.parametrize(
    "name", ["clock_skew", "lost_blocks", "rolling_shutter", "flicker", "misalignment", "video_codec"]
)
def test_what_the_rig_has_of_its_own_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="not one of an emulated rig"):
        ticker([name])


def test_effects_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a fault"):
        rig_of(plan_of(), tmp_path / "take", effects=["shoot_noise"])
    with pytest.raises(UsageError, match="a fault"):
        rig_of(plan_of(), tmp_path / "take", effects="seen")
    scene = world_of("chroma", 3, (64, 48), 20_000.0, VirtualHost(0), None).spec
    assert effects_of("scene", scene, "test") == scene.effects != ()
