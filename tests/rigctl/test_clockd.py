"""The clock service on the emulated box, through the real driver: errors against truth, and everything that breaks."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from clock_bench import Bench, S

from spikerig.calib.clock import fit_rig
from spikerig.dataset import cli
from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.dataset.marks import Probe, Reset, read_marks
from spikerig.rigctl.clock_page import Page, address, metrics
from spikerig.rigctl.clockd import ClockService
from spikerig.rigctl.sim.emulate.harpbox import BoxFaults


@pytest.mark.parametrize("seed", [0, 1])
def test_it_knows_the_boxs_time_and_how_well(seed):
    bench = Bench(seed=seed)
    off = []
    for until in range(10, 200, 2):
        bench.turns(until)
        off.append(bench.off_us())
    off = np.array(off)
    assert (off[10:, 0] <= 100).all()
    assert (off[:, 0] <= off[:, 1]).mean() >= 0.95
    assert bench.box["state"] == "locked"
    assert bench.box["skew_ppm"] == pytest.approx(35 + 200 / 60, abs=1)
    assert bench.box["left_out"] <= 2


def test_unplugged_it_holds_over_and_goes_on_in_the_same_epoch():
    bench = Bench(faults=BoxFaults(unplugged=((100 * S, 160 * S),)))
    bench.turns(158)
    off, good = bench.off_us()
    assert bench.box["state"] == "holding over"
    assert bench.box["hold_over_s"] > 55
    assert off <= min(good, 150)
    assert "gone" in bench.service.status()["trouble"] or "opened" in bench.service.status()["trouble"]
    bench.turns(175)
    assert bench.box["state"] == "locked"
    assert bench.box["epoch"] == 0
    assert bench.box["resets"] == 0
    assert bench.service.status()["trouble"] == ""
    assert bench.off_us()[0] <= min(100, bench.off_us()[1])


def test_a_box_that_boots_begins_an_epoch_and_keeps_its_skew(tmp_path):
    bench = Bench(tmp_path, BoxFaults(resets=(60 * S,)))
    bench.turns(66)
    assert bench.box["epoch"] == 1
    assert (bench.box["resets"], bench.box["steps"], bench.box["left_out"]) == (1, 0, 0)  # told, not guessed
    assert bench.box["skew_ppm"] == pytest.approx(36, abs=2)
    off, good = bench.off_us()
    assert off <= min(good, 300)
    bench.run(120)
    marks = list(read_marks(tmp_path / "marks.jsonl"))
    assert [m.epoch for m in marks if isinstance(m, Reset)] == [1]
    clocks = fit_rig(marks)  # and after the fact the host carries rig time over
    at = np.array([70, 90, 110]) * S
    first = int(bench.wire.clock.device_from_true(0))
    true = bench.wire.clock.device_from_true(at) - first
    zero = clocks.origin_ns - (1_700_000_000 * S + first)
    assert np.abs(clocks.fit("host").model.rig_from_device(at) - (true - zero)).max() <= 150_000
    assert clocks.notes


def test_a_suspend_is_told_and_the_box_found_again(tmp_path):
    bench = Bench(tmp_path)
    bench.turns(60)
    bench.host.suspend(3600 * S)
    bench.turns(70)
    assert bench.off_us()[0] <= min(300, bench.off_us()[1])
    assert bench.box["epoch"] == 0
    assert bench.service.status()["suspended_s"] == 3600
    bench.run(100)
    resets = [m for m in read_marks(tmp_path / "marks.jsonl") if isinstance(m, Reset)]
    assert [(m.clock, m.epoch) for m in resets] == [("host", 1)]
    assert "3600" in resets[0].why
    clocks = fit_rig(list(read_marks(tmp_path / "marks.jsonl")))
    before, after = clocks.fit("host").model.rig_from_device([50 * S, 90 * S])
    assert after - before == pytest.approx(3640 * S, rel=1e-3)


def test_damaged_lost_and_doubled_answers_do_no_harm():
    bench = Bench(faults=BoxFaults(corrupt=0.1, lose=0.05, twice=0.1))
    bench.turns(100)
    assert bench.off_us()[0] <= min(100, bench.off_us()[1])
    assert bench.box["epoch"] == 0


def test_a_box_that_is_not_there_yet():
    bench = Bench(faults=BoxFaults(unplugged=((0, 30 * S),)))
    bench.turns(20)
    assert bench.box["state"] == "searching"
    with pytest.raises(DeviceError, match="never heard"):
        bench.service.box_at(bench.host.now_ns())
    assert bench.opened <= 12  # patience grows
    bench.turns(45)
    assert bench.box["state"] == "locked"


def test_raw_marks_and_fits_are_kept_and_can_be_fitted_anew(tmp_path, capsys):
    bench = Bench(tmp_path)
    bench.run(62)
    marks = list(read_marks(tmp_path / "marks.jsonl"))
    assert len([m for m in marks if m.sent_ns is not None]) >= 59 * 8
    assert [m for m in marks if m.sent_ns is None]  # what the box said by itself
    fits = [json.loads(line) for line in (tmp_path / "fits.jsonl").read_text().splitlines()]
    assert [f["clocks"][0]["state"] for f in fits] == ["locked"] * 3
    assert cli.run(["calib", "clock", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [c["clock"] for c in told["clocks"]] == ["host", "box"]
    assert cli.run(["calib", "clock", str(tmp_path)]) == 2
    assert "--force" in capsys.readouterr().err
    assert cli.run(["calib", "clock", str(tmp_path), "--force"]) == 0
    with pytest.raises(UsageError):
        ClockService(bench.host, bench.open, tmp_path)  # marks are never written over
    (tmp_path / "file").write_text("")
    with pytest.raises(HostError):
        ClockService(bench.host, bench.open, tmp_path / "file" / "sub")


def test_stamps_of_a_camera_are_watched_beside_it():
    bench = Bench()
    rng = np.random.default_rng(0)
    for until in range(1, 20):
        bench.turns(until)
        now = bench.host.now_ns()
        sent = now - np.arange(40) * 2_000_000
        bench.service.feed([
            Probe("spike", 0, None, int(t * (1 + 2e-5)), int(t + 150_000 + 50_000 * rng.exponential())) for t in sent
        ])  # fmt: skip
    spike = next(c for c in bench.service.status()["clocks"] if c["clock"] == "spike")
    assert spike["bias_bound_us"] == 5000
    assert spike["uncertainty_us"] >= 5000
    assert abs(spike["offset_ns"] - 20_000 * bench.host.now_ns() / S + 150_000) < 300_000


def get(page, path="/status", **headers):
    link = http.client.HTTPConnection("127.0.0.1", page.port, timeout=5)
    link.request("GET", path, headers=headers)
    answer = link.getresponse()
    return answer.status, answer.read().decode()


def test_the_page_shows_the_status_as_json_and_for_prometheus():
    bench = Bench()
    bench.turns(10)
    page = Page("127.0.0.1:0", bench.service.status)
    try:
        code, body = get(page)
        assert code == 200
        assert json.loads(body)["clocks"][0]["clock"] == "box"
        code, body = get(page, "/metrics")
        assert 'spikerig_clock_locked{clock="box"} 1\n' in body
        value = float(body.split('spikerig_clock_uncertainty_seconds{clock="box"} ')[1].split("\n")[0])
        assert value == pytest.approx(json.loads(get(page)[1])["clocks"][0]["uncertainty_us"] * 1e-6)
        assert get(page, "/else")[0] == 404
        assert get(page, Host="evil.example")[0] == 403
        with pytest.raises(HostError):
            Page(f"127.0.0.1:{page.port}", bench.service.status)
    finally:
        page.close()
    searching = {"clocks": [{"clock": "box", "state": "searching", "marks": 0}]}
    assert 'locked{clock="box"} 0' in metrics(searching)


def test_others_need_a_token():
    with pytest.raises(UsageError, match="token"):
        Page("0.0.0.0:0", dict)
    page = Page("0.0.0.0:0", lambda: {"clocks": []}, "a-secret-of-some-length")
    try:
        assert get(page)[0] == 401
        assert get(page, Authorization="Bearer a-secret")[0] == 401
        assert get(page, Authorization="Bearer a-secret-of-some-length")[0] == 200
    finally:
        page.close()


def test_addresses():
    assert address("127.0.0.1") == ("127.0.0.1", 8790)
    assert address("[::1]:9") == ("::1", 9)
    assert address("localhost:80") == ("localhost", 80)
    for wrong in (":5", "host:port", "host:99999", ""):
        with pytest.raises(UsageError):
            address(wrong)


def test_served_asked_and_ended_by_a_signal(tmp_path, capsys):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{probe.getsockname()[1]}"
    assert cli.run(["rig", "clock", "status", "--bind", where]) == 3
    words = [
        "rig",
        "clock",
        "serve",
        "--emulate",
        "--bind",
        where,
        "-o",
        str(tmp_path / "c"),
        "--json",
        "--every-s",
        "0.2",
    ]
    served = subprocess.Popen(
        [sys.executable, "-m", "spikerig.dataset", *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    try:
        capsys.readouterr()
        for _ in range(600):
            if cli.run(["rig", "clock", "status", "--bind", where, "--json"]) == 0:
                told = json.loads(capsys.readouterr().out)
                if told["clocks"][0]["state"] == "locked":
                    break
            capsys.readouterr()
            time.sleep(0.1)
        assert told["clocks"][0]["state"] == "locked"
        served.send_signal(signal.SIGTERM)
        out, _ = served.communicate(timeout=20)
    finally:
        served.kill()
    assert served.returncode == 0
    assert json.loads(out)["clocks"][0]["marks"] > 0
    assert list(read_marks(tmp_path / "c" / "marks.jsonl"))


def test_wrong_words_are_told(tmp_path, capsys):
    assert cli.run(["rig", "clock", "dance"]) == 2
    short = tmp_path / "token"
    short.write_text("short")
    assert cli.run(["rig", "clock", "status", "--token-file", str(short)]) == 2
    assert cli.run(["rig", "clock", "status", "--token-file", str(tmp_path / "none")]) == 6
    assert cli.run(["rig", "clock", "serve", "--port", "/dev/none", "--bind", "127.0.0.1:0", "--burst", "0"]) == 2
    assert "burst" in capsys.readouterr().err
