"""Loose pictures: BRISQUE's known answer, judges by path, references, and what hostile files get."""

import json

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional as F

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import srgb_from_linear, write_image
from spikerig.train import judges
from spikerig.train.judges import crops, open_lpips, open_rankiqa
from spikerig.train.quality import read_codes


def told(capsys, *words, code: int = 0) -> dict:
    assert run(["train", "quality", *map(str, words), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def picture(seed: int, h: int = 48, w: int = 64) -> np.ndarray:
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    base = 128 + 90 * np.sin(x / 4 + seed) * np.cos(y / 5)
    return np.clip(base[..., None] + np.random.default_rng(seed).normal(0, 9, (h, w, 3)), 0, 255).astype(np.uint8)


def brisque(shared_data) -> list[str]:
    files = [shared_data(f"brisque/brisque_{kind}_live.yml") for kind in ("model", "range")]
    return ["--brisque-model", str(files[0]), "--brisque-range", str(files[1])]


@pytest.mark.real
def test_goldhill_has_opencvs_brisque(shared_data, capsys):
    found = told(capsys, shared_data("brisque/goldhill.gif"), *brisque(shared_data))
    assert found["pictures"][0]["brisque"] == pytest.approx(9.4465, abs=5e-5)
    assert found["judges"]["brisque"]["implementation"] == f"OpenCV {cv2.__version__} cv2.quality.QualityBRISQUE"
    assert len(found["judges"]["brisque"]["model_sha256"]) == 64
    assert found["judges"]["rankiqa"].startswith("not computed")


@pytest.mark.real
def test_brisque_of_flat_and_tiny_pictures_is_withheld_and_of_half_flat_ones_flagged(shared_data, tmp_path, capsys):
    half = picture(0, 64, 64)
    half[:40] = 90
    for name, pixels in (("flat", np.full((64, 64, 3), 90, np.uint8)), ("tiny", picture(1, 15, 64)), ("half", half)):
        write_image(tmp_path / f"{name}.png", pixels)
    rows = told(capsys, *sorted(tmp_path.iterdir()), *brisque(shared_data))["pictures"]
    flat, half, tiny = rows
    assert (flat["brisque"], flat["flat"]) == (None, True)
    assert any("means nothing" in r for r in flat["remarks"])
    assert half["brisque"] is not None
    assert any("not to be trusted" in r for r in half["remarks"])
    assert tiny["brisque"] is None
    assert any("smaller than 16x16" in r for r in tiny["remarks"])


@pytest.mark.real
def test_damaged_brisque_files_are_told_both_at_once(shared_data, tmp_path, capsys):
    write_image(tmp_path / "a.png", picture(0))
    model = shared_data("brisque/brisque_model_live.yml").read_text()
    ranges = shared_data("brisque/brisque_range_live.yml").read_text()
    spoilt = {
        "an empty file": ("", ""),
        "cut off": (model[: len(model) // 2], ranges[:200]),
        "swapped": (ranges, model),
        "fewer features": (model.replace("var_count: 36", "var_count: 35"), ranges.replace("cols: 36", "cols: 12")),
        "no vectors": (model.replace("sv_total: 774", "sv_total: 9"), ranges.replace("dt: f", "dt: u")),
        "not text": ("\0" * 99, "%YAML:1.0\n---\n: : :\n"),
    }
    for case, (one, other) in spoilt.items():
        (tmp_path / "m.yml").write_text(one)
        (tmp_path / "r.yml").write_text(other)
        words = ["--brisque-model", tmp_path / "m.yml", "--brisque-range", tmp_path / "r.yml"]
        error = told(capsys, tmp_path / "a.png", *words, code=4)["error"]
        assert "m.yml" in error["value"], case
        assert "r.yml" in error["value"], case


def test_half_a_brisque_is_a_usage_fault(tmp_path, capsys):
    write_image(tmp_path / "a.png", picture(0))
    error = told(capsys, tmp_path / "a.png", "--brisque-model", tmp_path / "m.yml", code=2)["error"]
    assert "ranges" in error["what"]


def test_without_weights_only_sharpness_is_there_and_the_rest_is_null_and_named(tmp_path, capsys):
    write_image(tmp_path / "a.png", picture(0))
    found = told(capsys, tmp_path / "a.png")
    row = found["pictures"][0]
    assert row["brisque"] is row["rankiqa"] is None
    assert "psnr" not in row
    assert 0 < row["crete_blur"] < 1
    assert set(found["judges"].values()) == {"not computed: no weights given"}
    assert set(found["measures"]) <= set(row)


def test_references_are_matched_by_stem_and_equal_pictures_are_null_with_a_reason(tmp_path, capsys):
    (tmp_path / "ref").mkdir()
    for name, other in (("a", 1), ("b", 2)):
        write_image(tmp_path / f"{name}.png", picture(1))
        write_image(tmp_path / "ref" / f"{name}.png", picture(other))
    a, b = told(capsys, tmp_path / "a.png", tmp_path / "b.png", "--reference", tmp_path / "ref")["pictures"]
    assert a["psnr"] is None
    assert any("equal" in r for r in a["remarks"])
    assert a["ssim"] == pytest.approx(1)
    error = picture(1).astype(float) - picture(2)
    assert b["psnr"] == pytest.approx(10 * np.log10(255**2 / np.mean(error**2)))
    assert b["lpips"] is None


def test_all_faults_are_told_at_once(tmp_path, capsys):
    (tmp_path / "ref").mkdir()
    good = tmp_path / "good.png"
    write_image(good, picture(0))
    (tmp_path / "cut.png").write_bytes(good.read_bytes()[:200])
    (tmp_path / "text.jpg").write_text("no picture")
    (tmp_path / "bomb.gif").write_bytes(b"GIF89a" + b"\xff\xff\xff\xff" + b"\0" * 9)
    (tmp_path / "cut.gif").write_bytes(b"GIF89a" + b"\x10\0\x10\0" + b"\0" * 9)
    nan = np.full((20, 20, 3), 0.5, np.float32)
    nan[2, 3] = np.nan
    write_image(tmp_path / "nan.exr", nan)
    names = ["cut.png", "text.jpg", "bomb.gif", "cut.gif", "nan.exr", "missing.png"]
    error = told(capsys, good, *(tmp_path / n for n in names), code=4)["error"]
    assert "6 of 7" in error["what"]
    for name in names:
        assert name in error["value"], name
    write_image(tmp_path / "ref" / "good.png", picture(0, 40, 64))
    assert "sizes" in told(capsys, good, "--reference", tmp_path / "ref", code=2)["error"]["what"]
    assert told(capsys, tmp_path / "nan.exr", code=5)["error"]["type"] == "NumericsError"


def test_hdr_sixteen_bits_gray_and_alpha_become_codes(tmp_path):
    light = np.linspace(-0.1, 4, 300, dtype=np.float32).reshape(10, 10, 3)
    write_image(tmp_path / "hdr.exr", light)
    loose = read_codes(tmp_path / "hdr.exr")
    assert np.array_equal(loose.codes, np.rint(srgb_from_linear(np.clip(light, 0, 1)) * 255))
    assert "above" in loose.remarks[0]
    deep = np.arange(300, dtype=np.uint16).reshape(10, 10, 3) * 200
    write_image(tmp_path / "deep.png", deep)
    assert np.array_equal(read_codes(tmp_path / "deep.png").codes, np.rint(deep / 257))
    write_image(tmp_path / "gray.png", picture(0)[:, :, 0])
    assert read_codes(tmp_path / "gray.png").codes.shape == (48, 64, 3)
    clear = np.dstack([picture(0), np.full((48, 64), 255, np.uint8)])
    write_image(tmp_path / "opaque.png", clear)
    assert np.array_equal(read_codes(tmp_path / "opaque.png").codes, picture(0))
    clear[0, 0, 3] = 0
    write_image(tmp_path / "clear.png", clear)
    with pytest.raises(UsageError, match="transparent"):
        read_codes(tmp_path / "clear.png")
    assert read_codes(tmp_path / "clear.png", "white").codes[0, 0].tolist() == [255] * 3


class Distance(torch.nn.Module):
    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a - b).abs().mean()


class Bias(torch.nn.Module):
    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a - b).abs().mean() + 0.5


class Blue(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, 0].mean(dim=[1, 2]) + 1000.0 * float(x.shape[2] != 224)


def script(path, module: torch.nn.Module):
    torch.jit.script(module).save(str(path))
    return path


def test_torchscript_runs_only_when_trusted(tmp_path, capsys):
    (tmp_path / "ref").mkdir()
    write_image(tmp_path / "a.png", picture(1))
    write_image(tmp_path / "ref" / "a.png", picture(2))
    file = script(tmp_path / "d.pt", Distance())
    words = [tmp_path / "a.png", "--reference", tmp_path / "ref", "--lpips", file]
    error = told(capsys, *words, code=2)["error"]
    assert "--trust" in error["next"]
    found = told(capsys, *words, "--trust")
    expected = np.abs(picture(1).astype(float) - picture(2)).mean() / 127.5
    assert found["pictures"][0]["lpips"] == pytest.approx(expected, rel=1e-5)
    assert found["judges"]["lpips"]["network"] == "TorchScript"
    assert told(capsys, tmp_path / "a.png", "--lpips", file, "--trust", code=2)["error"]["next"] == "--reference DIR"


def test_a_network_that_is_no_distance_is_refused(tmp_path):
    with pytest.raises(DataError, match="no distance"):
        open_lpips(script(tmp_path / "bias.pt", Bias()), trust=True)
    with pytest.raises(DataError, match="does not take"):
        open_rankiqa(script(tmp_path / "two.pt", Distance()), trust=True)
    for content in (b"PK\3\4 rubbish", b"rubbish", b""):
        (tmp_path / "x").write_bytes(content)
        with pytest.raises(DataError):
            open_lpips(tmp_path / "x", trust=True)
    with pytest.raises(DataError, match="no weights"):
        open_lpips(tmp_path / "nothing", trust=True)


def test_rankiqa_sees_its_crops_in_bgr(tmp_path):
    judge = open_rankiqa(script(tmp_path / "blue.pt", Blue()), trust=True)
    codes = np.zeros((300, 400, 3), np.uint8)
    codes[:, :, 2] = 77
    assert judge(codes) == pytest.approx(77)
    assert len(crops(300, 400)) == 30
    assert crops(300, 400)[0] == (0, 0)
    assert crops(300, 400)[-1] == (76, 176)
    assert crops(224, 224) == [(0, 0)]
    with pytest.raises(UsageError, match="too small"):
        judge(codes[:223])


def lpips_weights(shapes: dict[int, tuple[int, int, int]], taps, slices) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    out = {}
    for i, (w, c, k) in shapes.items():
        name = f"net.slice{next(n for n, last in enumerate(slices, 1) if i < last)}.{i}"
        out[f"{name}.weight"] = torch.randn((w, c, k, k), generator=g) / (c * k * k) ** 0.5
        out[f"{name}.bias"] = torch.randn(w, generator=g) * 0.1
    for n, t in enumerate(taps):
        out[f"lin{n}.model.1.weight"] = torch.rand((1, shapes[t][0], 1, 1), generator=g)
    return out


VGG = {i: (w, c, 3) for i, w, c in zip(judges.VGG_AT, judges.VGG_WIDTH, (3, *judges.VGG_WIDTH), strict=False)}


def lpips_by_hand(found, net: str, a: np.ndarray, b: np.ndarray) -> float:
    """LPIPS in float64 from its paper and torchvision's layer lists: each layer one by one."""
    alex = ["c", "r", "p", "c", "r", "p", "c", "r", "c", "r", "c", "r"]
    vgg = [x for n in (2, 2, 3, 3, 3) for x in ["c", "r"] * n + ["p"]][:-1]
    ends = (2, 5, 8, 10, 12) if net == "alex" else (4, 9, 16, 23, 30)
    flat = {k.split(".", 2)[2] if k.startswith("net") else k: t.double() for k, t in found.items()}

    def tower(x):
        x = torch.from_numpy(x.transpose(2, 0, 1)[None] / 127.5 - 1)
        x = (x - torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)) / torch.tensor([0.458, 0.448, 0.450]).view(
            1, 3, 1, 1
        )
        seen = []
        for i, kind in enumerate(alex if net == "alex" else vgg):
            if kind == "c":
                k = flat[f"{i}.weight"].shape[-1]
                x = F.conv2d(x, flat[f"{i}.weight"], flat[f"{i}.bias"], 4 if k == 11 else 1, {11: 2, 5: 2, 3: 1}[k])
            elif kind == "p":
                x = F.max_pool2d(x, 3 if net == "alex" else 2, 2)
            else:
                x = F.relu(x)
            if i + 1 in ends:
                seen.append(x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + 1e-10))
        return seen

    pairs = zip(tower(a), tower(b), strict=True)
    return sum(float((flat[f"lin{n}.model.1.weight"] * (x - y) ** 2).sum(1).mean()) for n, (x, y) in enumerate(pairs))


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_from_safetensors_is_its_definition(net, tmp_path, capsys):
    made = lpips_weights(judges.ALEX, judges.ALEX, (2, 5, 8, 10, 12)) if net == "alex" else lpips_weights(
        VGG, judges.VGG_TAPS, (4, 9, 16, 23, 30))  # fmt: skip
    save_file(made, tmp_path / "w.safetensors")
    judge = open_lpips(tmp_path / "w.safetensors", trust=False)
    a, b = picture(3), picture(4)
    assert judge(a, b) == pytest.approx(lpips_by_hand(made, net, a.astype(float), b.astype(float)), rel=2e-4)
    assert judge.about["network"].endswith("AlexNet" if net == "alex" else "VGG16")
    with pytest.raises(UsageError, match="too small"):
        judge(a[:20], b[:20])
    name = next(k for k in made if k.endswith(".8.weight" if net == "alex" else ".28.weight"))
    save_file({k: t for k, t in made.items() if k != name}, tmp_path / "w.safetensors")
    with pytest.raises(DataError, match="not the weights") as caught:
        open_lpips(tmp_path / "w.safetensors", trust=False)
    assert "weight" in caught.value.expected
    save_file(made | {name: made[name] * torch.nan}, tmp_path / "w.safetensors")
    with pytest.raises(DataError, match="not finite"):
        open_lpips(tmp_path / "w.safetensors", trust=False)


@pytest.mark.parametrize("names", ["torchvision", "caffe"])
def test_rankiqas_vgg16_is_found_under_both_names(names, tmp_path, monkeypatch):
    """Constant layers, whose score is known: the last convolution's bias c, 25088 of it, through three layers."""
    one = torch.ones(())
    made = {}
    for i, w, c in zip(judges.VGG_AT, judges.VGG_WIDTH, (3, *judges.VGG_WIDTH), strict=False):
        made[f"features.{i}.weight"], made[f"features.{i}.bias"] = (0 * one).expand(w, c, 3, 3), (one * i).expand(w)
    for k, o, n, weight in ((0, 4096, 25088, 1e-3), (3, 4096, 4096, 1e-3), (6, 1, 4096, -1e-2)):
        made[f"classifier.{k}.weight"], made[f"classifier.{k}.bias"] = (one * weight).expand(o, n), (one / 2).expand(o)
    if names == "caffe":
        conv = {f"features.{i}.": f"features.conv{c}." for i, c in zip(judges.VGG_AT, judges.VGG_CAFFE, strict=True)}
        conv |= {"classifier.0.": "classifier.fc6_m.", "classifier.3.": "classifier.fc7_m."}
        conv |= {"classifier.6.": "classifier.fc8_m."}
        made = {next(b + k.removeprefix(a) for a, b in conv.items() if k.startswith(a)): t for k, t in made.items()}
    (tmp_path / "w").write_bytes(b"x")
    monkeypatch.setattr(judges, "_tensors", lambda path: made)
    expected = ((25088 * 28 * 1e-3 + 0.5) * 4096 * 1e-3 + 0.5) * 4096 * -1e-2 + 0.5
    judge = open_rankiqa(tmp_path / "w", trust=False)
    assert judge(np.zeros((224, 224, 3), np.uint8)) == pytest.approx(
        expected, rel=1e-3
    )  # float32 sums of 25088 equal terms
    made.pop(next(k for k in made if k.startswith("classifier")))
    with pytest.raises(DataError, match="not the weights of RankIQA"):
        open_rankiqa(tmp_path / "w", trust=False)
