"""`spikerig data info | texture | import`: what they write, print and refuse."""

import json

import cv2
import numpy as np
import pytest
from spike_bytes import random_pixels, vidar

from spikerig.dataset import cli, oracles, texture
from spikerig.dataset.flat import FlatField, write_flat
from spikerig.dataset.images import read_image, write_image
from spikerig.dataset.spikes import SpikeStream, open_spikes, write_spikes


@pytest.fixture
def run(capsys):
    """Run a command line: (exit code, JSON document or None, text on stderr)."""

    def call(*words):
        capsys.readouterr()
        code = cli.run([str(w) for w in words])
        said = capsys.readouterr()
        return code, json.loads(said.out) if said.out else None, said.err

    return call


@pytest.fixture
def dat(tmp_path):
    """A Vidar file of 60 ticks in which one pixel is dark; and its pixels."""
    pixels = random_pixels(60, 250, 400)
    pixels[:, 3, 5] = 0
    path = tmp_path / "a.dat"
    path.write_bytes(np.packbits(pixels[:, ::-1], axis=2, bitorder="little").tobytes())
    return path, pixels


def test_info_of_a_raster(run, dat):
    code, told, _ = run("data", "info", dat[0], "--rate-hz", 40000, "--json")
    assert code == 0
    assert told["schema"] == "spikerig.data.info/1"
    rate = told.pop("spike_rate")
    assert rate == pytest.approx(dat[1].mean(), abs=1e-6)
    expect = {
        "format": "dat", "width": 400, "height": 250, "ticks": 60, "row_bits": 400, "rate_hz": 40000.0,
        "duration_s": 0.0015, "bytes": 750_000, "lost": [],
    }  # fmt: skip
    assert {k: told[k] for k in expect} == expect
    code, told, text = run("data", "info", dat[0])
    assert (code, told) == (0, None)
    assert "rate_hz      not known" in text


def test_info_asks_and_refuses_with_the_right_exit(run, tmp_path):
    path = tmp_path / "both.dat"
    path.write_bytes(bytes(325_000))
    code, told, text = run("data", "info", path, "--json")
    assert code == 2
    assert "--row-bits" in told["error"]["next"]
    assert run("data", "info", path, "--row-bits", 416)[0] == 0
    path.write_bytes(bytes(12_501))
    code, _, text = run("data", "info", path)
    assert code == 4
    assert "1 left over after 1 ticks of 12500 B" in text
    assert run("data", "info", path, "--row-bits", 400, "--drop-tail")[0] == 0
    assert run("data", "info", tmp_path / "none.dat")[0] == 2
    assert run("data", "info", tmp_path)[0] == 2


def test_info_of_every_kind_of_file(run, tmp_path):
    s = SpikeStream(oracles.pack(random_pixels(30, 4, 13)), 13, 1000.0, 9, "c", np.array([[2, 4]]))
    for name in ("a.h5", "a.npz"):
        write_spikes(tmp_path / name, s)
        _, told, _ = run("data", "info", tmp_path / name, "--json")
        assert (told["ticks"], told["rate_hz"], told["lost"], told["clock"]) == (30, 1000.0, [[2, 4]], "c")
        assert told["duration_s"] == 0.03
    np.savez(tmp_path / "b.npz", spk=random_pixels(30, 4, 13).transpose(1, 2, 0))
    _, told, _ = run("data", "info", tmp_path / "b.npz", "--axes", "HWT", "--json")
    assert (told["ticks"], told["height"], told["width"], told["rate_hz"]) == (30, 4, 13, None)
    write_image(tmp_path / "a.png", np.full((3, 5), 7, np.uint8))
    _, told, _ = run("data", "info", tmp_path / "a.png", "--json")
    assert (told["format"], told["width"], told["height"], told["most"]) == ("png", 5, 3, 7)
    write_image(tmp_path / "a.exr", np.full((3, 5), np.nan, np.float32))
    _, told, _ = run("data", "info", tmp_path / "a.exr", "--json")
    assert (told["format"], told["width"], told["transfer"], told["not_finite"]) == ("exr", 5, "linear", 15)
    np.save(tmp_path / "a.npy", np.array([[1, np.nan]], np.float32))
    _, told, _ = run("data", "info", tmp_path / "a.npy", "--json")
    assert (told["format"], told["known"], told["mean_light"]) == ("texture", 0.5, 1.0)
    np.save(tmp_path / "b.npy", np.arange(3))
    assert run("data", "info", tmp_path / "b.npy")[0] == 4
    (tmp_path / "c.npy").write_bytes(b"no")
    assert run("data", "info", tmp_path / "c.npy")[0] == 4


@pytest.mark.parametrize("method", ["tfp", "tfi", "tfi-causal", "tfp-adaptive"])
def test_texture_is_that_of_the_whole_stream(run, dat, tmp_path, method):
    path, pixels = dat
    whole = SpikeStream.from_pixels(pixels)
    for at in (0, 17, 30.7, 59, 60):
        expect = {
            "tfp": lambda at=at: texture.tfp(whole, at, 41),
            "tfi": lambda at=at: texture.tfi(whole, at),
            "tfi-causal": lambda at=at: texture.tfi(whole, at, causal=True),
            "tfp-adaptive": lambda at=at: texture.tfp_adaptive(whole, at),
        }[method]()
        code, told, _ = run(
            "data", "texture", path, "--method", method, "--at", at, "-o", tmp_path / "t.npy", "--force", "--json"
        )
        assert code == 0
        made = np.load(tmp_path / "t.npy")
        assert made.dtype == np.float32
        assert np.array_equal(made, expect.with_nan(), equal_nan=True), at
        assert told["known"] == pytest.approx(expect.known.mean())


@pytest.mark.parametrize("window", [1, 4, 41, 500])
def test_texture_window(run, dat, tmp_path, window):
    path, pixels = dat
    code, told, _ = run(
        "data", "texture", path, "--method", "tfp", "--at", 30, "--window", window, "-o", tmp_path / "t.npy", "--json"
    )
    assert code == 0
    t0, t1 = max(30 - window // 2, 0), min(30 - window // 2 + window, 60)
    assert told["window"] == [t0, t1]
    assert np.array_equal(np.load(tmp_path / "t.npy"), (pixels[t0:t1].mean(0)).astype(np.float32))


def test_tfi_widens_its_search_until_all_is_known(run, tmp_path):
    pixels = np.zeros((3000, 2, 8), np.uint8)
    pixels[[0, 2999]] = 1
    pixels[:, 1] = 1
    write_spikes(tmp_path / "a.h5", SpikeStream.from_pixels(pixels))
    words = ("data", "texture", tmp_path / "a.h5", "--method", "tfi", "--at", 1400, "-o", tmp_path / "t.npy", "--json")
    _, told, _ = run(*words)
    assert told["known"] == 1.0
    assert np.load(tmp_path / "t.npy")[0, 0] == np.float32(1 / 2999)
    _, told, _ = run(*words, "--force", "--reach", 300)
    assert told["known"] == 0.5
    assert told["window"] == [1100, 1700]


def test_texture_pictures(run, dat, tmp_path):
    path, pixels = dat
    light = pixels[10:51].mean(0)
    at = ("data", "texture", path, "--at", 30)
    code, _, text = run(*at, "-o", tmp_path / "t.png", "--gain", 2)
    assert code == 0
    assert "gain 2" in text
    picture = cv2.imread(str(tmp_path / "t.png"), cv2.IMREAD_UNCHANGED)
    linear = np.clip(2 * light, 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(picture - 255 * srgb).max() <= 0.501
    _, told, _ = run(*at, "-o", tmp_path / "u.png", "--json")
    assert told["gain"] > 1
    run(*at, "-o", tmp_path / "t.exr", "--method", "tfi")
    exr = read_image(tmp_path / "t.exr", nonfinite="keep")[:, :, 0]
    expect = texture.tfi(SpikeStream.from_pixels(pixels), 30).with_nan()
    assert np.array_equal(exr, expect, equal_nan=True)
    assert np.isnan(exr[3, 5])  # the dark pixel


@pytest.mark.parametrize(
    "words",
    [
        ("--at", "61"), ("--at", "-1"), ("--at", "nan"), ("--at", "3", "--method", "tfx"),
        ("--at", "3", "--method", "tfi", "--window", "4"), ("--at", "3", "--window", "0"),
        ("--at", "3", "--intervals", "2"), ("--at", "3", "--gain", "bright"), ("--at", "3", "--gain", "0"),
        ("--at", "3", "--method", "tfi", "--reach", "0"),
    ],
)  # fmt: skip
def test_texture_refuses(run, dat, tmp_path, words):
    code, _, text = run("data", "texture", dat[0], "-o", tmp_path / "t.npy", *words)
    assert code == 2, text
    assert not (tmp_path / "t.npy").exists()


def test_outputs_are_not_replaced_unasked(run, dat, tmp_path):
    for name in ("t.npy", "t.png", "t.exr"):
        (tmp_path / name).write_bytes(b"precious")
        assert run("data", "texture", dat[0], "--at", 3, "-o", tmp_path / name)[0] == 2
        assert (tmp_path / name).read_bytes() == b"precious"
        assert run("data", "texture", dat[0], "--at", 3, "-o", tmp_path / name, "--force")[0] == 0
    assert run("data", "texture", dat[0], "--at", 3, "-o", tmp_path / "t.jpg")[0] == 2
    (tmp_path / "b.h5").write_bytes(b"precious")
    assert run("data", "import", dat[0], "-o", tmp_path / "b.h5")[0] == 2
    assert (tmp_path / "b.h5").read_bytes() == b"precious"
    assert run("data", "import", dat[0], "-o", tmp_path / "b.dat")[0] == 2


def test_import_keeps_everything(run, tmp_path):
    pixels = random_pixels(5, 250, 400)
    (tmp_path / "a.dat").write_bytes(vidar(pixels, 416))
    code, told, _ = run("data", "import", tmp_path / "a.dat", "-o", tmp_path / "a.h5", "--rate-hz", 20000, "--json")
    assert code == 0
    assert told["schema"] == "spikerig.data.import/1"
    assert told["ticks"] == 5
    with open_spikes(tmp_path / "a.h5") as file:
        s = file.read()
    assert np.array_equal(oracles.unpack(s.bits, 400), pixels)
    assert s.rate_hz == 20000
    np.savez(tmp_path / "b.npz", spk=pixels.transpose(1, 2, 0))
    assert run("data", "import", tmp_path / "b.npz", "--axes", "HWT", "-o", tmp_path / "b.h5")[0] == 0
    with open_spikes(tmp_path / "b.h5") as file:
        assert np.array_equal(file.read().bits, s.bits)
        assert file.rate_hz is None


def test_an_import_that_fails_leaves_nothing(run, tmp_path):
    np.savez(tmp_path / "b.npz", spk=np.full((9, 4, 4), 3, np.uint8))
    assert run("data", "import", tmp_path / "b.npz", "--axes", "THW", "-o", tmp_path / "b.h5")[0] == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.npz"]


def test_info_and_texture_of_a_scene(run, tmp_path):
    from hard_store import full_scene

    from spikerig.dataset.store import write_scene

    scene = full_scene()
    write_scene(tmp_path / "s.h5", scene)
    code, told, _ = run("data", "info", tmp_path / "s.h5", "--json")
    assert code == 0
    assert (told["format"], told["name"], told["views"]) == ("scene", scene.name, len(scene.views))
    view = next(v for v in scene.views if v.spikes is not None and v.spikes.ticks > 4)
    out = tmp_path / "t.npy"
    words = ("data", "texture", tmp_path / "s.h5", "--at", 2, "--window", 4, "-o", out)
    code, _, text = run(*words, "--view", view.name)
    assert code == 0, text
    assert np.array_equal(np.load(out), texture.tfp(view.spikes, 2, 4).with_nan(), equal_nan=True)
    code, _, text = run(*words, "--force")
    assert code == 2
    assert "--view" in text


def test_a_texture_in_colour(run, tmp_path):
    """As the scene says, as the command says, or off."""
    from dataclasses import replace

    from hard_store import full_scene

    from spikerig.dataset.bayer import Bayer, demosaic
    from spikerig.dataset.images import read_image
    from spikerig.dataset.store import write_scene

    scene = replace(full_scene(), info={"sensor": {"bayer": "gbrg", "channel_gain": [2.0, 1.0, 1.5]}})
    write_scene(tmp_path / "s.h5", scene)
    spikes = scene.view("v-01.x").spikes
    gray = texture.tfp(spikes, 30, 8)
    words = ("data", "texture", tmp_path / "s.h5", "--view", "v-01.x", "--at", 30, "--window", 8, "--force", "--json")
    for more, want, pattern in (
        ((), demosaic(gray, Bayer("gbrg", (2.0, 1.0, 1.5))), "gbrg"),
        (("--bayer", "rggb"), demosaic(gray, Bayer("rggb")), "rggb"),
        (("--bayer", "off"), gray, None),
    ):
        code, told, text = run(*words, *more, "-o", tmp_path / "t.npy")
        assert code == 0, text
        assert told["bayer"] == pattern
        assert np.array_equal(np.load(tmp_path / "t.npy"), want.with_nan(), equal_nan=True)
    assert run(*words, "-o", tmp_path / "t.png", "--gain", 1)[0] == 0
    shown = read_image(tmp_path / "t.png")
    assert shown.shape == (13, 21, 3)
    assert not np.array_equal(shown[:, :, 0], shown[:, :, 2])
    assert run(*words, "--bayer", "rgbg", "-o", tmp_path / "t.npy")[0] == 2


def test_a_texture_is_evened_out_on_request(run, dat, tmp_path):
    rng = np.random.default_rng(4)
    gain = (1 + 0.1 * rng.standard_normal((250, 400))).astype(np.float32).clip(0.5, 2)
    dark, good = np.full_like(gain, 0.01), np.ones(gain.shape, bool)
    good[7, 9] = False
    write_flat(tmp_path / "flat.npz", FlatField(gain, dark, good, np.ones_like(gain)))
    words = ("data", "texture", dat[0], "--at", 30, "--json", "-o")
    assert run(*words, tmp_path / "raw.npy")[0] == 0
    code, told, _ = run(*words, tmp_path / "even.npy", "--flat", tmp_path / "flat.npz")
    assert code == 0
    assert told["method"] == "tfp-41-flat"
    assert told["flat"] == str(tmp_path / "flat.npz")
    raw, even = (np.load(tmp_path / f"{name}.npy") for name in ("raw", "even"))
    assert np.isnan(even[7, 9])
    np.testing.assert_allclose(even[good], np.maximum(raw - 0.01, 0)[good] / gain[good], rtol=1e-5)
    write_flat(
        tmp_path / "other.npz", FlatField(*(np.ones((3, 4), t) for t in (np.float32, np.float32, bool, np.float32)))
    )
    code, told, _ = run(*words, tmp_path / "c.npy", "--flat", tmp_path / "other.npz")
    assert code == 2
    assert "another sensor" in told["error"]["what"]
    assert run(*words, tmp_path / "c.npy", "--flat", tmp_path / "none.npz")[0] == 4
    assert not (tmp_path / "c.npy").exists()
