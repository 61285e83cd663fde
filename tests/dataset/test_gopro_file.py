"""GoPro clips: the real one's known answers, emulated ones against their truth, and hostile ones."""

import json
import struct

import av
import numpy as np
import pytest
from gopro_clips import clip, grey

from spikerig.dataset import cli, gopro_pictures
from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.gopro_file import chapters, open_gopro
from spikerig.dataset.gopro_pictures import read_pictures
from spikerig.dataset.gopro_times import nearest, through
from spikerig.dataset.mp4_boxes import read_movie, read_samples
from spikerig.rigctl.sim.emulate.gpmf_write import box, telemetry_track


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    paths, take = clip(tmp_path_factory.mktemp("clip"), skipped=(50, 50, 130))
    return paths[0], take


@pytest.mark.real
def test_the_real_clip_has_its_known_answers(shared_data, capsys):
    path = shared_data("gopro/max-heromode.mp4")
    assert cli.run(["data", "info", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["model"], told["firmware"]) == (315, "GoPro Max", "H19.03.01.30.00")
    assert told["srot_ms"] == pytest.approx(20.6008, abs=1e-4)
    assert told["fps"] == pytest.approx(30000 / 1001)
    assert told["duration_s"] == pytest.approx(315 * 1001 / 30000)
    exposure = told["exposure_s"]
    assert 1 / 1670 < exposure["min"] < exposure["median"] < exposure["max"] < 1 / 990
    assert {"ACCL", "GYRO", "SHUT", "ISOE", "CORI", "GPS5"} <= set(told["streams"])
    assert told["streams"]["HUES"]["samples"] == 98  # as its TSMP says: a repeated key is a sample each


@pytest.mark.real
def test_the_real_clips_frames_lie_on_its_stamps(shared_data):
    read = open_gopro(shared_data("gopro/max-heromode.mp4"))
    assert read.time_source == "CORI"
    assert read.start_ns[[0, 30, 60]].tolist() == [85_608_000, 1_086_608_000, 2_087_608_000]
    assert np.ptp(np.diff(read.start_ns)) <= 1
    assert read.streams["ACCL"].values[0] == pytest.approx([8.61630695, 0.47482014, 1.61870504])  # gpmf-parser's
    assert read.row_ns == pytest.approx(20.600767e6 / 480)


@pytest.mark.real
def test_pictures_by_number_are_those_of_reading_them_all(shared_data):
    read = open_gopro(shared_data("gopro/max-heromode.mp4"))
    whole = dict(read_pictures(read, range(120)))
    for number, frame in read_pictures(read, [119, 3, 77, 3]):
        assert np.array_equal(frame.pixels, whole[number].pixels)
        assert frame.start_ns == read.start_ns[number]
        assert frame.exposure_ns == read.exposure_ns[number]
    last = [n for n, _ in read_pictures(read, [0, 314])]
    assert last == [0, 314]


def test_an_emulated_clips_times_are_the_true_ones_on_its_clock(plain):
    path, take = plain
    read = open_gopro(path)
    assert read.frames == 150
    error = read.start_ns - take.media_ns[:150]
    assert np.abs(error).max() <= 1000  # stamps count microseconds
    steps = np.rint(np.diff(read.start_ns) / np.median(np.diff(read.start_ns)))
    assert np.flatnonzero(steps != 1).tolist() == [49, 129]
    assert steps[49] == 3
    assert np.flatnonzero(read.skipped).tolist() == [50, 130]
    assert read.skipped[50] == 2
    assert any("skipped" in r for r in read.remarks)
    assert read.exposure_ns.tolist() == [2083333] * 150
    assert (read.model, read.settings["EISE"], read.settings["VFPS"]) == ("HERO9 Black", "N", [120000, 1001])


def test_streams_of_one_sample_a_frame_have_the_frames_times(plain):
    read = open_gopro(plain[0])
    for key in ("CORI", "SHUT", "ISOE", "MSKP"):
        assert np.array_equal(read.streams[key].at_ns[:150], read.start_ns)
    assert len(read.streams["CORI"].values) == 151  # one stamp more than frames, as in the real clip


def test_pictures_show_what_was_there_at_their_time(plain):
    path, take = plain
    read = open_gopro(path)
    for number, frame in read_pictures(read, read.frames_between(read.start_ns[60], read.start_ns[70])):
        assert 60 <= number < 70
        assert abs(frame.pixels.mean() - grey(int(take.true_starts_ns[number]))) < 3


def test_each_frame_has_its_own_exposure(tmp_path):
    told = np.linspace(1 / 2000, 1 / 240, 150)
    paths, _ = clip(tmp_path, exposure_s=told)
    assert open_gopro(paths[0]).exposure_ns / 1e9 == pytest.approx(told, rel=1e-6)


def test_exposures_of_a_payload_that_is_missing_are_the_nearest(tmp_path):
    told = np.linspace(1 / 2000, 1 / 240, 150)
    (path, *_), _ = clip(tmp_path, exposure_s=told)
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"SHUTf\x04\x00\x78", b"SHUXf\x04\x00\x78"))
    seconds = open_gopro(path).exposure_ns / 1e9
    assert seconds[120:] == pytest.approx(told[120:], rel=1e-6)
    assert seconds[:120] == pytest.approx(np.full(120, told[120]), rel=1e-6)


def test_without_stamps_of_frames_exposures_go_by_number(tmp_path):
    told = np.linspace(1 / 2000, 1 / 240, 150)
    (path, *_), _ = clip(tmp_path, exposure_s=told, spare=0)
    path.write_bytes(path.read_bytes().replace(b"CORIs", b"CORXs"))
    read = open_gopro(path)
    assert read.time_source == "pts"
    assert any("CORI" in r for r in read.remarks)
    assert read.exposure_ns / 1e9 == pytest.approx(told, rel=1e-6)


def test_times_bend_at_each_stamp():
    knots, stamps = np.array([0.0, 10, 30]), np.array([1000.0, 1100, 1320])
    at = through("CORI", knots, stamps, np.array([0.0, 5, 10, 20, 30, 40]), 10.0)
    assert at.tolist() == [1000, 1050, 1100, 1210, 1320, 1430]
    with pytest.raises(DataError, match="contradict"):
        through("CORI", knots, stamps, knots, 4.0)
    with pytest.raises(DataError, match="contradict"):
        through("ACCL", knots, stamps[::-1], knots, 10.0, strict=False)


def test_chapters_are_joined_without_a_seam(tmp_path):
    paths, take = clip(tmp_path, frames=160, chapter_bytes=6_000)
    assert len(paths) >= 2
    assert chapters(paths[-1]) == paths
    read = open_gopro(chapters(paths[0]))
    assert (read.frames, len(read.chapter_frames)) == (160, len(paths))
    assert np.abs(read.start_ns - take.media_ns[:160]).max() <= 1000
    at = read.chapter_frames[0]
    for number, frame in read_pictures(read, range(at - 2, at + 2)):
        assert abs(frame.pixels.mean() - grey(int(take.true_starts_ns[number]))) < 3
    if len(paths) > 2:
        paths[1].unlink()
        with pytest.raises(DataError, match="chapter of the clip is missing"):
            chapters(paths[0])


def test_chapters_of_other_clips_are_refused(tmp_path):
    (tmp_path / "b").mkdir()
    one, _ = clip(tmp_path)
    other, _ = clip(tmp_path / "b", header={"CASN": "another"})
    with pytest.raises(DataError, match="different clips"):
        open_gopro([*one, *other])


def test_chapters_whose_stamps_begin_anew_follow_each_other(tmp_path):
    (tmp_path / "b").mkdir()
    one, _ = clip(tmp_path, frames=30)
    two, _ = clip(tmp_path / "b", frames=30)
    read = open_gopro([*one, *two])
    assert np.diff(read.start_ns) == pytest.approx(np.full(59, 1001e9 / 120e3), abs=1001)
    assert any("begin anew" in r for r in read.remarks)
    assert read.frames == 60


def test_a_clip_without_telemetry_has_the_videos_grid(tmp_path, plain):
    raw = plain[0].read_bytes().replace(b"gpmd", b"xxxx")
    path = tmp_path / "a.mp4"
    path.write_bytes(raw)
    read = open_gopro(path)
    assert (read.time_source, read.exposure_ns, read.streams) == ("pts", None, {})
    assert read.start_ns[[0, 120]].tolist() == [0, 1_001_000_000]


def test_frames_and_numbers_out_of_the_clip(plain):
    read = open_gopro(plain[0])
    with pytest.raises(UsageError):
        list(read_pictures(read, [150]))
    with pytest.raises(UsageError):
        open_gopro([])
    with pytest.raises(UsageError):
        open_gopro(plain[0].with_name("none.mp4"))


# ---- hostile files --------------------------------------------------------------------------------------------------


def spoiled(raw, kind, change):
    """A copy with `change(bytearray, place of the payload)` made in the last box of a kind."""
    out = bytearray(raw)
    change(out, out.rfind(kind) + 4)
    return bytes(out)


def number(offset, n, size=4):
    def change(out, at):
        out[at + offset : at + offset + size] = n.to_bytes(size, "big")

    return change


HOSTILE = {
    "empty": lambda raw: b"",
    "cut in the pictures": lambda raw: raw[: len(raw) // 2],
    "cut in moov": lambda raw: raw[:-100],
    "moov missing": lambda raw: raw.replace(b"moov", b"free"),
    "not an mp4": lambda raw: b"\x89PNG" * 100,
    "box of 0 bytes in moov": lambda raw: spoiled(raw, b"mdhd", number(-8, 0)),
    "box of 4 bytes": lambda raw: spoiled(raw, b"mdhd", number(-8, 4)),
    "box larger than its parent": lambda raw: spoiled(raw, b"stbl", number(-8, 1 << 31)),
    "long box of 2^63 bytes": lambda raw: struct.pack(">I4sQ", 1, b"ftyp", 1 << 63) + raw,
    "moov of 3 GB": lambda raw: struct.pack(">I4s", 3 << 30, b"moov") + raw,
    "two moov": lambda raw: raw + raw[raw.rfind(b"moov") - 4 :],
    "2^32 samples": lambda raw: spoiled(raw, b"stsz", number(8, 0xFFFFFFFF)),
    "2^32 samples of 1 byte": lambda raw: spoiled(spoiled(raw, b"stsz", number(8, 0xFFFFFFFF)), b"stsz", number(4, 1)),
    "2^31 samples in a run": lambda raw: spoiled(raw, b"stts", number(8, 1 << 31)),
    "runs of another count": lambda raw: spoiled(raw, b"stts", number(8, 3)),
    "no such chunk": lambda raw: spoiled(raw, b"stsc", number(8, 7)),
    "chunks of 2^31": lambda raw: spoiled(raw, b"stsc", number(12, 1 << 31)),
    "offset beyond the end": lambda raw: spoiled(raw, b"stco", number(8, 1 << 31)),
    "long offset beyond the end": lambda raw: long_offset(raw, 1 << 40),
    "long offset of 2^64 - 1": lambda raw: long_offset(raw, 2**64 - 1),
    "timescale 0": lambda raw: spoiled(raw, b"mdhd", number(12, 0)),
    "nested 10,000 deep": lambda raw: raw[: raw.rfind(b"moov") - 4] + deep(10_000),
    "100,000 tiny boxes": lambda raw: raw[: raw.rfind(b"moov") - 4] + box("moov", box("free") * 100_000),
    "no video": lambda raw: raw.replace(b"vide", b"vidx"),
    "telemetry claims too much": lambda raw: raw.replace(b"SHUTf\x04\x00", b"SHUTf\x04\xff", 1),
    "telemetry of odd size": lambda raw: raw.replace(b"SHUTf\x04", b"SHUTf\x03", 1),
    "exposure NaN": lambda raw: raw.replace(struct.pack(">f", 1 / 480), b"\x7f\xc0\0\0", 1),
    "exposure negative": lambda raw: raw.replace(struct.pack(">f", 1 / 480), b"\xbf\x80\0\0", 1),
    "read-out NaN": lambda raw: raw.replace(b"SROTf\x04\x00\x01\x40\xe0", b"SROTf\x04\x00\x01\x7f\xc0"),
    "read-out as text": lambda raw: raw.replace(b"SROTf\x04\x00\x01", b"SROTc\x04\x00\x01"),
    "scale 0": lambda raw: raw.replace(b"SCALs\x02\x00\x01\x7f\xff", b"SCALs\x02\x00\x01\x00\x00"),
    "stamp of a million years": lambda raw: raw.replace(b"STMPJ\x08\x00\x01\0\0", b"STMPJ\x08\x00\x01\x7f\xff"),
    "stamps that step back": lambda raw: raw.replace(struct.pack(">Q", 85_608), struct.pack(">Q", 9_085_608)),
}  # fmt: skip


CAUSES = {  # words of the cause, where another check would refuse the file too, later
    "empty": "empty", "cut in moov": "cut off", "moov missing": "no moov", "box larger than its parent": "claims",
    "nested 10,000 deep": "deeper than", "100,000 tiny boxes": "more than 20000 boxes", "two moov": "two moov",
    "offset beyond the end": "beyond the end of the file", "long offset beyond the end": "beyond the end of the file",
    "moov of 3 GB": "claims", "2^32 samples": "samples", "chunks of 2^31": "chunk", "timescale 0": "0 units",
    "telemetry claims too much": "SHUT", "scale 0": "SCAL", "stamps that step back": "CORI",
}  # fmt: skip


def long_offset(raw, offset):
    """A track with one telemetry sample at a 64-bit offset, in place of all others."""
    return raw[: raw.rfind(b"moov") - 4] + box("moov", telemetry_track(1, [8], [offset], [1001], 1000))


def deep(levels):
    out = b""
    for _ in range(levels):
        out = box("udta", out)
    return box("moov", out)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_clear_error(name, plain, tmp_path):
    raw = plain[0].read_bytes()
    bad = HOSTILE[name](raw)
    assert bad != raw
    path = tmp_path / "bad.mp4"
    path.write_bytes(bad)
    with pytest.raises(DataError) as told:
        open_gopro(path)
    assert "bad.mp4" in str(told.value)
    assert told.value.cause
    assert CAUSES.get(name, "") in told.value.cause


def samples_agree(path):
    """Offsets and sizes of the pictures are those that FFmpeg finds."""
    track = next(t for t in read_movie(path).tracks if t.handler == "vide")
    with av.open(str(path)) as container:
        found = [(p.pos, p.size, p.pts) for p in container.demux(video=0) if p.size]
    first = found[0][2]
    assert [f[:2] for f in found] == list(zip(track.offsets.tolist(), track.sizes.tolist(), strict=True))
    assert [f[2] - first for f in found] == (track.pts - track.pts[0]).tolist()


def test_samples_lie_where_ffmpeg_finds_them(plain):
    samples_agree(plain[0])


@pytest.mark.real
def test_samples_of_the_real_clip_lie_where_ffmpeg_finds_them(shared_data):
    samples_agree(shared_data("gopro/max-heromode.mp4"))


def test_a_far_picture_is_reached_from_the_key_frame_before_it(tmp_path, monkeypatch):
    paths, _ = clip(tmp_path, frames=400)
    seen = []
    true = gopro_pictures._number
    monkeypatch.setattr(gopro_pictures, "_number", lambda *a: seen.append(true(*a)) or seen[-1])
    assert [n for n, _ in read_pictures(open_gopro(paths), [3, 390])] == [3, 390]
    assert len(seen) < 40


def test_long_offsets_are_read(tmp_path):
    path = tmp_path / "long.mp4"
    with path.open("wb") as file:  # sparse: the sample lies beyond 4 GB, moov behind it
        file.write(struct.pack(">I4s", 20, b"ftyp") + b"mp41" + bytes(8))
        file.write(struct.pack(">I4sQ", 1, b"mdat", (5 << 30) - 20))
        file.seek((5 << 30) - 8)
        file.write(b"payloads" + box("moov", telemetry_track(1, [8], [(5 << 30) - 8], [1001], 1000)))
    movie = read_movie(path)
    assert list(read_samples(path, movie.tracks[0])) == [b"payloads"]


def test_zero_box_at_the_end_of_the_file_is_allowed(plain, tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(plain[0].read_bytes() + struct.pack(">I4s", 0, b"free") + bytes(20))
    assert open_gopro(path).frames == 150


def fuzz(raw, path, rounds, seed):
    """Flip bytes of moov and of the telemetry; whatever comes is a RigError or a clip."""
    rng = np.random.default_rng(seed)
    moov = raw.rfind(b"moov")
    good = 0
    for _ in range(rounds):
        out = bytearray(raw)
        span = (moov, len(raw)) if rng.random() < 0.7 else (max(raw.find(b"DEVC") - 100, 0), moov)
        for at in rng.integers(*span, size=rng.integers(1, 6)):
            out[at] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.integers(256)])
        path.write_bytes(out)
        try:
            read = open_gopro(path)
            assert np.all(np.diff(read.start_ns) >= 0)
            good += 1
        except RigError:
            pass
    return good


def test_flipped_bytes_never_bring_a_traceback(plain, tmp_path):
    good = fuzz(plain[0].read_bytes(), tmp_path / "fuzz.mp4", 400, 1)
    assert 0 < good < 400


@pytest.mark.real
def test_flipped_bytes_of_the_real_clip_never_bring_a_traceback(shared_data, tmp_path):
    raw = shared_data("gopro/max-heromode.mp4").read_bytes()
    good = fuzz(raw, tmp_path / "fuzz.mp4", 120, 2)
    assert 0 < good < 120


def test_flipped_bytes_in_the_pictures_are_a_data_error_or_a_picture(plain, tmp_path):
    raw, rng, path = plain[0].read_bytes(), np.random.default_rng(5), tmp_path / "fuzz.mp4"
    for _ in range(20):
        out = bytearray(raw)
        for at in rng.integers(40, raw.find(b"DEVC") - 8, size=20):
            out[at] = rng.integers(256)
        path.write_bytes(out)
        try:
            told = len(list(read_pictures(open_gopro(path), range(0, 150, 10))))
        except DataError as error:
            told = str(error)
        assert told == 15 or "fuzz.mp4" in str(told)


def test_data_info_of_a_hostile_file_is_exit_4(tmp_path, capsys):
    path = tmp_path / "bad.mp4"
    path.write_bytes(b"nothing at all in here")
    assert cli.run(["data", "info", str(path), "--json"]) == 4
    assert json.loads(capsys.readouterr().out)["error"]["type"] == "DataError"


def test_nearest_is_the_brute_force():
    rng = np.random.default_rng(0)
    at, wanted = np.sort(rng.integers(0, 1000, 40)), rng.integers(-50, 1050, 200)
    near = nearest(at, wanted)
    assert np.array_equal(np.abs(at[near] - wanted), np.abs(at[:, None] - wanted).min(0))
    assert nearest(np.array([5]), wanted).tolist() == [0] * 200


def test_frames_coded_by_themselves_are_told_through_chapters(tmp_path):
    paths, _ = clip(tmp_path, 100, chapter_bytes=300)
    assert len(paths) > 1
    key = open_gopro(paths).key
    assert np.flatnonzero(key).tolist() == list(range(0, 100, 15))


@pytest.mark.parametrize("number", [0, 101, 1 << 31])
def test_a_key_frame_that_is_not_there_is_refused(tmp_path, number):
    (path,), _ = clip(tmp_path, 100)
    raw = path.read_bytes()
    at = raw.rfind(b"stss") + 12
    path.write_bytes(raw[:at] + number.to_bytes(4, "big") + raw[at + 4 :])
    with pytest.raises(DataError, match="damaged"):
        open_gopro(path)
