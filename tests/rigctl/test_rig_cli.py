"""`rig find` and `rig probe` on emulated devices and on dumps."""

import json

import numpy as np
import pytest
from framing_scenes import wire_bytes
from vidar_bench import K20

from spikerig.dataset import cli
from spikerig.dataset.rawtake import open_take
from spikerig.rigctl import open_rig, rig_cli, usbport
from spikerig.rigctl.probe import examine
from spikerig.rigctl.profiles import PROFILES

K416 = PROFILES["vidar-400x250-20k-416"]

PLAN = """name = "small"
viewpoints = 1
seconds = 0.1
advance = "auto"
[spike.wire]
name = "tiny"
width = 64
height = 48
row_bits = 64
rate_hz = 20000
packet_bytes = 16384
[rgb]
use = false
[checks]
spare_gb = 0.001
[recorder]
on_full = "wait"
ring_s = 0.3
"""


@pytest.fixture
def spec(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text('[spike]\nprofile = "vidar-400x250-20k-416"\nserial = "E1"\nppm = 35.0\ntrailer = 0x0a5f\n')
    return path


def told(capsys, *words):
    code = cli.run([*words, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_find_tells_what_is_there_and_why_not(spec, capsys, monkeypatch):
    monkeypatch.setattr(rig_cli, "FINDERS", {"spike": rig_cli.FINDERS["spike"]})
    code, doc = told(capsys, "rig", "find", "--emulate", str(spec))
    assert (code, doc["missing"]) == (0, [])
    (device,) = doc["kinds"]["spike"]["devices"]
    assert (device["model"], device["serial"], device["address"], device["firmware"]) == (
        "FT601",
        "E1",
        "usb:2-1",
        "1.09",
    )
    assert device["bus_bytes_s"] == 400e6
    spec.write_text('[spike]\nfaults = [{kind = "denied"}]\n')
    code, doc = told(capsys, "rig", "find", "--emulate", str(spec))
    assert (code, doc["missing"]) == (1, ["spike"])
    assert "udevadm" in doc["kinds"]["spike"]["reasons"][0]


def test_find_sees_all_three_kinds_of_the_shipped_rig(capsys):
    code, doc = told(capsys, "rig", "find", "--emulate", "demo")
    assert (code, doc["missing"], doc["emulated"]) == (0, [], True)
    models = {kind: found["devices"][0]["model"] for kind, found in doc["kinds"].items()}
    assert models["spike"] == "FT601"
    assert models["rgb"].startswith("HERO9")
    assert models["sync"].startswith("harp")


def test_find_without_libusb_goes_on_with_the_other_kinds(capsys, monkeypatch):
    monkeypatch.setattr(usbport, "_load", lambda: None)
    monkeypatch.setattr(
        rig_cli, "FINDERS", {"spike": rig_cli.FINDERS["spike"], "sync": lambda bench: ([], ["no port"])}
    )
    code, doc = told(capsys, "rig", "find")
    assert (code, doc["missing"]) == (1, ["spike", "sync"])
    assert "libusb-package" in doc["kinds"]["spike"]["reasons"][0]
    assert doc["kinds"]["sync"]["reasons"] == ["no port"]


def test_probe_tells_the_row_width_of_an_emulated_camera(spec, tmp_path, capsys):
    dump = tmp_path / "dump.raw"
    code, doc = told(capsys, "rig", "probe", "--emulate", str(spec), "-o", str(dump), "--megabytes", "4")
    assert (code, doc["convincing"], doc["row_bits"]) == (0, K416.name, 416)
    best = doc["hypotheses"][0]
    assert best["trailer"] == "constant 0x0a5f"
    assert abs(best["rate_hz"] - 20_000.7) < 0.05
    assert best["phase_confidence"] > 0.99
    assert dump.stat().st_size == 4_000_000
    code, again = told(capsys, "rig", "probe", "--file", str(dump))
    assert (code, again["convincing"], again["bytes_s"]) == (0, K416.name, None)
    assert again["hypotheses"][0]["phase_bytes"] == best["phase_bytes"]
    code, doc = told(capsys, "rig", "probe", "--emulate", str(spec), "-o", str(dump))
    assert code == 2  # the dump is there already
    assert "--force" in doc["error"]["next"]


def test_probe_settles_what_the_size_of_a_file_cannot():
    for profile in (K20, K416):  # 325,000 bytes are 26 ticks of 12,500 or 25 of 13,000: 8 times that
        data = wire_bytes(profile, "texture", 2_600_000 // profile.tick_bytes)
        assert len(data) == 2_600_000
        seen = examine(data, list(PROFILES.values()))
        assert seen.convincing.profile.row_bits == profile.row_bits
        assert seen.convincing.phase == 0


def test_probe_convinces_nobody_on_noise_or_in_the_dark(tmp_path, capsys):
    rng = np.random.default_rng(0)
    dump = tmp_path / "noise"
    for data in (
        rng.integers(0, 256, 2_000_000, dtype=np.uint8),
        np.zeros(2_000_000, np.uint8),
        np.full(99, 7, np.uint8),
    ):
        dump.write_bytes(data.tobytes())
        code, doc = told(capsys, "rig", "probe", "--file", str(dump))
        assert (code, doc["convincing"]) == (1, None)
        assert all(h["confidence"] < 0.1 for h in doc["hypotheses"])


def test_probe_knows_megapixel_tags(tmp_path):
    m1 = PROFILES["m1k40-1000x1000-20k"]
    seen = examine(wire_bytes(m1, "texture", 5)[1000:], list(PROFILES.values()))
    assert seen.convincing.profile is m1
    assert seen.convincing.tags


def test_probe_of_a_users_geometry(tmp_path, capsys):
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\nwidth = 128\nheight = 80\nrow_bits = 144\nrate_hz = 20000\n')
    spec = tmp_path / "rig.toml"
    spec.write_text(f'[spike]\nprofile = "{mine}"\n')
    code, doc = told(capsys, "rig", "probe", "--emulate", str(spec), "--megabytes", "1")
    assert (code, doc["convincing"], doc["row_bits"]) == (0, "mine", 144)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--file", "none.raw"], 2),
        (["--megabytes", "0"], 2),
        (["--profile", "none"], 2),
        (["--emulate", "none.toml"], 2),
        (["--file", "a", "--emulate", "b"], 2),
    ],
)
def test_probe_refuses_what_makes_no_sense(words, code, capsys):
    assert told(capsys, "rig", "probe", *words)[0] == code


def test_a_camera_that_says_nothing_is_told(tmp_path, capsys):
    spec = tmp_path / "rig.toml"
    spec.write_text('[spike]\nfaults = [{kind = "hang"}]\n')
    code, doc = told(capsys, "rig", "probe", "--emulate", str(spec))
    assert code == 3
    assert "says nothing" in doc["error"]["what"]
    spec.write_text("[spike\n")
    assert told(capsys, "rig", "probe", "--emulate", str(spec))[0] == 2


def test_find_probe_and_record_read_the_same_rig(tmp_path, capsys):
    rig, plan = tmp_path / "rig.toml", tmp_path / "plan.toml"
    rig.write_text('[spike]\nserial = "E7"\nppm = 35.0\nram_bytes = 16777216\n')
    plan.write_text(PLAN)
    code, doc = told(capsys, "rig", "find", "--emulate", str(rig))
    assert (code, doc["kinds"]["spike"]["devices"][0]["serial"]) == (0, "E7")
    code, doc = told(capsys, "rig", "probe", "--emulate", str(rig), "--megabytes", "4", "--serial", "E7")
    assert code == 0
    code, _ = told(capsys, "rig", "record", str(plan), "-o", str(tmp_path / "take"), "--emulate", str(rig))
    assert code == 0
    assert open_take(tmp_path / "take").devices[0]["serial"] == "E7"
    rig.write_text('[spike]\nserail = "E7"\n')
    for words in (["find"], ["probe"], ["record", str(plan), "-o", str(tmp_path / "none")]):
        code, doc = told(capsys, "rig", *words, "--emulate", str(rig))
        assert code == 2
        assert "serail" in json.dumps(doc)


def test_a_plan_beyond_the_link_is_refused_before_any_device_is_touched(tmp_path, capsys, monkeypatch):
    plan, folder = tmp_path / "plan.toml", tmp_path / "take"
    plan.write_text('name = "fast"\nviewpoints = 40\nseconds = 1.0\n[spike]\nprofile = "vidar-400x250-40k-416"\n')
    monkeypatch.setattr(open_rig, "open_rig", lambda *_: pytest.fail("a device was touched"))
    for words in (["-o", str(folder)], ["-o", str(folder), "--emulate", "demo"]):
        code, doc = told(capsys, "rig", "record", str(plan), *words)
        assert (code, folder.exists()) == (2, False)
        assert "520 MB/s" in doc["error"]["value"]
        assert "360 MB/s" in json.dumps(doc["error"])
