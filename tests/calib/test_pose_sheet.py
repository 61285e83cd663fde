"""The contact sheet of a completed scene: everything on it, nothing hostile, never too large."""

import base64
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calib_worlds import ring
from spoil_checks import pixels, spikes, views, write_good

from spikerig.calib.plots import Spot, axes_of, bars, camera_plots, histogram
from spikerig.calib.pose_cli import quantiles
from spikerig.dataset import cli
from spikerig.dataset.scene import Scene
from spikerig.dataset.store import write_scene

EVIL = "</title><script>alert(1)</script>&\"'"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    path = tmp_path_factory.mktemp("sheet") / "good.h5"
    return path, write_good(path)


def sheet_of(scene: Scene, folder: Path, *words: str) -> str:
    write_scene(folder / "scene.h5", scene)
    assert cli.run(["data", "sheet", str(folder / "scene.h5"), "-o", str(folder / "sheet.html"), *words]) == 0
    return (folder / "sheet.html").read_text(encoding="utf-8")


def decoded(page: str) -> list[np.ndarray]:
    data = [base64.b64decode(text) for text in re.findall(r'src="data:image/png;base64,([^"]+)"', page)]
    return [cv2.imdecode(np.frombuffer(d, np.uint8), cv2.IMREAD_UNCHANGED) for d in data]


class Tags(HTMLParser):
    """All tags and attributes of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))


def svgs(page: str) -> list[ET.Element]:
    return [ET.fromstring(text) for text in re.findall(r"<svg.*?</svg>", page, re.S)]


def test_all_is_on_the_page(good: tuple[Path, Scene], tmp_path: Path) -> None:
    train = [v.name for v in good[1].views if v.split == "train"]
    record = {
        "accepted": True, "registered": 6, "images": 6, "error_px": 0.31, "kinds": ["tfp96"],
        "versions": {"pycolmap": "4.2"}, "residual_px": {n: 0.2 + 0.01 * k for k, n in enumerate(train)},
        "observations": dict.fromkeys(train, 321), "point_residuals": [0.1, 0.2, 0.9],
    }  # fmt: skip
    page = sheet_of(replace(good[1], info={**good[1].info, "poses": record}), tmp_path)
    for words in ("6 of 6 placed, mean residual 0.31 px", "tfp96", "pycolmap 4.2", "from above", "from the side",
                  "edges of both arms apart", "mean reprojection error", "residuals of the map", "321 observations",
                  "residual 0.23 px", "6 to train on, 1 held out", "no textures: no spikes"):  # fmt: skip
        assert words in page, words
    pictures = decoded(page)
    assert len(pictures) == 6 * 5 + 1
    assert [p.shape for p in pictures[:5]] == [(60, 96, 3), (60, 96), (60, 96), (60, 96, 3), (60, 96, 3)]
    np.testing.assert_array_equal(pictures[0][..., ::-1], good[1].views[0].frame.pixels)
    for texture in pictures[1:3]:
        gray = good[1].views[0].frame.pixels.mean(2)
        assert np.corrcoef(texture.ravel(), gray.ravel())[0, 1] > 0.6
    assert len(svgs(page)) == 2 + 5


def test_names_and_records_of_others_do_no_harm(good: tuple[Path, Scene], tmp_path: Path) -> None:
    record: dict[str, Any] = {
        "registered": EVIL, "images": [EVIL] * 3, "error_px": {EVIL: EVIL}, "kinds": EVIL, "versions": [[EVIL]],
        "residual_px": {"000": EVIL, "001": 1e300, "002": True, "004": None}, "observations": [1, 2],
        "point_residuals": [EVIL, None, 0.5], "forced": True,
    }  # fmt: skip
    evil = replace(good[1], name=EVIL, info={"poses": record, "align": {"calibration": EVIL}}, calibration=None)
    page = sheet_of(evil, tmp_path)
    tags = Tags(page).seen
    assert "script" not in {tag for tag, _ in tags}
    assert {tag for tag, _ in tags} <= {
        "meta", "title", "style", "h1", "h2", "p", "table", "tr", "th", "td", "br", "img", "div",
        "svg", "g", "rect", "line", "circle", "polyline", "polygon", "text",
    }  # fmt: skip
    assert all(not key.startswith("on") and key != "href" for _, attrs in tags for key in attrs)
    assert "http" not in page
    assert "REFUSED AND FORCED" in page
    assert "alert(1)" in page  # as text


@pytest.mark.parametrize("info", [{"poses": [1], "align": "x"}, {"poses": {}, "align": None}])
def test_records_that_are_none(good: tuple[Path, Scene], tmp_path: Path, info: dict[str, Any]) -> None:
    assert "poses</th><td>as given" in sheet_of(replace(good[1], info=info), tmp_path)


def test_a_page_fits(good: tuple[Path, Scene], tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noisy = pixels(lambda p: rng.integers(0, 256, p.shape, np.uint8))(good[1])
    page = sheet_of(noisy, tmp_path, "--limit-mb", "0.2")
    assert len(page) < 200_000
    small = decoded(page)[0]
    assert 48 <= small.shape[1] < 96
    assert small.shape[0] / small.shape[1] == pytest.approx(60 / 96, abs=0.03)


def test_scenes_without_spikes_poses_or_points(good: tuple[Path, Scene], tmp_path: Path) -> None:
    bare = replace(views(lambda v: replace(v, trajectory=None))(spikes(lambda s: None)(good[1])), points=None)
    page = sheet_of(bare, tmp_path)
    assert len(decoded(page)) == 7
    assert "px, by view: none." in page


def test_a_sheet_is_not_replaced_unasked(good: tuple[Path, Scene], tmp_path: Path) -> None:
    words = ["data", "sheet", str(good[0]), "-o", str(tmp_path / "s.html")]
    (tmp_path / "s.html").write_text("mine")
    assert cli.run(words) == 2
    assert (tmp_path / "s.html").read_text() == "mine"
    assert cli.run([*words, "--force"]) == 0
    assert cli.run([*words, "--force", "--limit-mb", "0"]) == 2
    posing = ["calib", "poses", str(good[0]), "-o", str(tmp_path / "o"), "--sheet", str(tmp_path / "t.html")]
    assert cli.run(posing) == 2  # of no scene that is written
    assert cli.run([*posing[:-1], str(tmp_path / "s.html"), "--write-to", str(tmp_path / "p.h5")]) == 2


def test_cameras_stand_where_they_stand() -> None:
    poses = ring(9)
    across, ahead, up = axes_of(poses)
    np.testing.assert_allclose(np.stack([across, ahead, up]) @ np.stack([across, ahead, up]).T, np.eye(3), atol=1e-12)
    assert up[2] > 0.9
    spots = [Spot(f"<{k}>", p, "test" if k == 3 else "train", None) for k, p in enumerate(poses)]
    plots = camera_plots(spots, np.zeros((50, 3)))
    above, side = svgs(plots)
    at = np.array([[float(c.get("cx", 0)), float(c.get("cy", 0))] for c in above.iter("circle") if c.get("r") == "3"])
    centres = np.stack([s.centre for s in spots])
    want = np.stack([centres @ across, -centres @ ahead], 1)
    scale = np.ptp(at[:, 0]) / np.ptp(want[:, 0])
    np.testing.assert_allclose(at - at.mean(0), scale * (want - want.mean(0)), atol=0.11)
    level = [float(c.get("cy", 0)) for c in side.iter("circle") if c.get("r") == "3"]
    assert np.ptp(level) < 0.02 * 420  # all at one height
    assert sum(g.get("class") == "test" for g in above.iter("g")) == 1
    assert [t.text for t in above.iter("title")] == [s.name for s in spots]
    for spot, wedge in zip(spots, above.iter("polygon"), strict=True):
        tip, *ends = (np.array([float(v) for v in p.split(",")]) for p in (wedge.get("points") or "").split())
        look = np.array([spot.pose[2, :3] @ across, -spot.pose[2, :3] @ ahead])
        assert (np.mean(ends, 0) - tip) @ look / np.linalg.norm(look) > 10


def test_plots_of_numbers() -> None:
    drawn = ET.fromstring(histogram([0.1, 0.1, 0.9, float("nan")], "x & y", bound=0.5))
    counts = [r.findtext("title") for r in drawn.iter("rect")]
    assert sum(int((c or "").split()[0]) for c in counts) == 3
    assert [r.get("class") for r in drawn.iter("rect") if not (r.findtext("title") or "").startswith("0")] == [
        "bar",
        "bad",
    ]
    assert "none" in histogram([], "x")
    many = ET.fromstring(bars({f"v{k}": float(k % 7) for k in range(500)}, "n"))
    assert len(list(many.iter("rect"))) == 120
    assert "120 of 500 shown" in "".join(t.text or "" for t in many.iter("text"))
    low = ET.fromstring(bars({"a": 9.0, "b": 9.0, "c": 1.0}, "n", high_is_bad=False))
    assert [r.get("class") for r in low.iter("rect")] == ["bar", "bar", "bad"]
    assert quantiles([3, 1, 2]) == [1, 2, 3]
    assert quantiles(np.arange(1001), 10) == pytest.approx(np.arange(50, 1000, 100))
