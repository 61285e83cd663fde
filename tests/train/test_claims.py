"""A table's arithmetic on made-up numbers: claims both ways, censoring, what is missing, and the page that tells it."""

from typing import Any

import numpy as np
import pytest

from spikerig.train.claims import ABSENT, FAILS, HOLDS, OPEN, TOLD, claims
from spikerig.train.table_numbers import cost_to_match, equal_dB, means, reach
from spikerig.train.table_page import page
from spikerig.train.table_pictures import curves, liveliest

SCENES = ("one", "two")


def history(*points: tuple[float, float]) -> list[dict[str, Any]]:
    """A curve of (CPU seconds, dB); a second is ten renders."""
    return [{"step": k, "cpu_seconds": c, "renders": 10 * c, "psnr": p} for k, (c, p) in enumerate(points)]


def cell(scene: str, row: str, psnr: float | None, seed: int = 0, curve=None, other=None, **cost) -> dict[str, Any]:
    """A finished cell; psnr None: a failed one."""
    told = {"scene": scene, "row": row, "seed": seed, "sha256": "0" * 64}
    if psnr is None:
        return told | {"status": "failed", "error": {"what": "fit: training | diverged"}}

    def part(value):
        return {"psnr": value, "ssim": 0.9, "lpips": None, "luma_psnr": value, "views": []}

    spent = {
        "steps": 100, "renders": 100, "renders_of": "pictures", "train_cpu_seconds": 10.0, "train_seconds": 11.0,
        "fit_cpu_seconds": 12.0, "fit_wall_seconds": 13.0, "fit_peak_bytes": 3e8, "attempts": 1, "unmeasured": False,
        "score_cpu_seconds": 2.0,
    }  # fmt: skip
    return told | {
        "status": "done", "error": None, "blur": part(psnr + 1), "novel": part(psnr),
        "other": None if other is None else part(other), "cost": spent | cost,
        "history": curve or history((0, 10), (10, psnr)),
    }  # fmt: skip


def table(cells: list[dict[str, Any]], seeds=(0,)) -> dict[str, Any]:
    """A document as `table_numbers.document` makes it."""
    names = list(dict.fromkeys(c["row"] for c in cells))
    rows = [{"name": n, "method": n.partition("@")[0], "label": n.partition("@")[2], "paper": None} for n in names]
    scenes = [
        {"name": s, "path": f"{s}.h5", "sha256": "1" * 64, "size": (64, 40), "train_views": 6, "test_views": 1,
         "other": None}
        for s in dict.fromkeys(c["scene"] for c in cells)
    ]  # fmt: skip
    doc: dict[str, Any] = {
        "cells": cells, "rows": rows, "scenes": scenes, "seeds": list(seeds), "field": "splat", "preset": "draft",
        "length": "100 steps", "command": "spikerig train table", "jobs": 1, "ssim_variant": "x", "lpips_variant": None,
        "machine": {"cpu": "c", "cores": 2, "isa": "i", "threads": 1, "commit": None},
    }  # fmt: skip
    doc["means"] = {name: means(doc, name) for name in names}
    doc["reach"] = equal_dB(doc)
    return doc | {"claims": claims(doc)}


def both(**rows: float) -> list[dict[str, Any]]:
    """Cells of rows on both scenes, a dB apart; `_at_` stands for @, `_` for -."""
    return [
        cell(scene, name.replace("_at_", "@").replace("_", "-"), psnr + k)
        for k, scene in enumerate(SCENES)
        for name, psnr in rows.items()
    ]


def verdict(doc: dict[str, Any], start: str) -> dict[str, Any]:
    found = [c for c in doc["claims"] if c["claim"].startswith(start)]
    assert len(found) == 1, start
    return found[0]


@pytest.mark.parametrize(
    ("start", "rows", "value", "margin"),
    [
        ("SpikeNeRF >= NeRF on blurry + 4 dB, label mid", {"spikenerf_at_mid": 28.5, "plain_at_mid": 24.0}, 4.5, 0.5),
        ("SpikeNeRF >= NeRF on blurry + 4 dB, label first", {"spikenerf_at_first": 25, "plain_at_first": 20}, 5, 1),
        ("SpikeNeRF 1x >= E2NeRF 2x", {"spikenerf_at_mid": 28.0, "e2_2x": 24.5}, 3.5, 0.5),
        ("ours >= SpikeNeRF 5x", {"ours": 31.0, "spikenerf_5x": 29.5}, 1.5, 0.5),
        ("ours >= trained on sharp", {"ours": 31.0, "oracle": 31.75}, -0.75, 0.25),
    ],
)
def test_each_claim_of_dB_both_ways(start, rows, value, margin):
    found = verdict(table(both(**rows)), start)
    assert found["verdict"] == HOLDS
    assert found["value"] == pytest.approx(value)
    assert found["margin"] == pytest.approx(margin)
    assert found["scenes"] == pytest.approx(dict.fromkeys(SCENES, value))
    one = next(iter(rows))
    less = verdict(table(both(**{**rows, one: rows[one] - 2 * margin})), start)
    assert less["verdict"] == FAILS
    assert less["margin"] == pytest.approx(-margin)
    assert "does not hold by" in less["text"]
    just = verdict(table(both(**{**rows, one: rows[one] - margin})), start)
    assert just["verdict"] == HOLDS  # exactly as much as claimed


def test_the_label_alone_is_told_without_a_verdict():
    found = verdict(table(both(plain_at_mid=24.0, plain_at_first=20.5)), "the label alone")
    assert (found["verdict"], found["wanted"]) == (TOLD, None)
    assert found["value"] == pytest.approx(3.5)


def test_a_claim_whose_rows_are_absent_or_failed_says_so():
    found = verdict(table(both(spikenerf_at_mid=28.0)), "SpikeNeRF 1x >= E2NeRF 2x")
    assert found["verdict"] == ABSENT
    assert "no row e2-2x" in found["text"]
    cells = both(ours=30.0) + [cell(s, "oracle", None) for s in SCENES]
    found = verdict(table(cells), "ours >= trained on sharp")
    assert found["verdict"] == ABSENT
    assert "oracle has no score" in found["text"]


def test_a_scene_without_one_of_the_rows_is_left_out_of_the_difference_and_counted():
    cells = [
        cell("one", "ours", 30.0),
        cell("two", "ours", 99.0),
        cell("one", "oracle", 30.5),
        cell("two", "oracle", None),
    ]
    found = verdict(table(cells), "ours >= trained on sharp")
    assert found["scenes"] == {"one": -0.5}
    assert found["value"] == -0.5
    assert "over 1 of 2 scenes" in found["text"]


def test_pictures_beside_a_scene_are_told_apart():
    cells = [cell("one", "ours", 30.0, other=25.0), cell("one", "spikenerf-5x", 28.0, other=24.75)]
    found = verdict(table(cells), "ours >= SpikeNeRF 5x")
    assert (found["value"], found["other"]) == (2.0, {"one": 0.25})
    assert "+0.25" in found["text"]


def test_dB_are_averaged_over_seeds_and_then_over_scenes():
    cells = [cell("one", "plain@mid", p, seed) for seed, p in enumerate((20.0, 24.0))]
    cells += [cell("two", "plain@mid", p, seed) for seed, p in enumerate((30.0, None))]
    found = table(cells, seeds=(0, 1))["means"]["plain@mid"]
    assert found["novel"]["psnr"] == pytest.approx((22 + 30) / 2)
    assert found["sd_psnr_novel"] == pytest.approx(np.std([25.0, 24.0], ddof=1))
    assert found["scenes"] == 2


def test_reach_is_linear_between_looks_and_censored_beyond():
    curve = history((0, 10), (4, 20), (8, 30), (9, 29))
    assert reach(curve, 25.0, "cpu_seconds") == (6.0, True)
    assert reach(curve, 25.0, "renders") == (60.0, True)
    assert reach(curve, 30.0, "cpu_seconds") == (8.0, True)
    assert reach(curve, 5.0, "cpu_seconds") == (0.0, True)
    assert reach(curve, 30.01, "cpu_seconds") == (9.0, False)
    assert reach(history(), 1.0, "cpu_seconds") == (0.0, False)
    no_score = [{"cpu_seconds": 3.0, "renders": 1, "psnr": None}]
    assert reach(no_score, 1.0, "cpu_seconds") == (3.0, False)


E2 = {s: history((0, 10), (50, 25), (100, 26)) for s in SCENES}


def cost_claim(curves_1x: dict[str, list], unit: str = "CPU s") -> dict[str, Any]:
    cells = [cell(s, "e2-5x", 26.0, curve=E2[s]) for s in SCENES]
    cells += [cell(s, "spikenerf@mid", c[-1]["psnr"], curve=c) for s, c in curves_1x.items()]
    return verdict(table(cells), f"SpikeNeRF reaches E2NeRF 5x's dB at <= 1/4 of its {unit}")


def test_a_quarter_of_the_cost_both_ways():
    fast = history((0, 10), (20, 26), (40, 28))
    for unit in ("CPU s", "renders"):
        found = cost_claim(dict.fromkeys(SCENES, fast), unit)
        assert (found["verdict"], found["value"]) == (HOLDS, pytest.approx(0.2))
    slow = history((0, 10), (60, 26), (80, 28))
    found = cost_claim({"one": fast, "two": slow})
    assert (found["verdict"], found["value"]) == (FAILS, pytest.approx(0.4))
    assert found["margin"] == pytest.approx(-0.15)


def test_a_cost_that_is_censored_never_holds_however_little_was_spent():
    never = history((0, 10), (40, 25.9))
    found = cost_claim(dict.fromkeys(SCENES, never))
    assert (found["verdict"], found["censored"], found["margin"]) == (FAILS, True, None)
    never = history((0, 10), (1, 25.9))
    found = cost_claim(dict.fromkeys(SCENES, never))
    assert (found["verdict"], found["censored"], found["margin"]) == (OPEN, True, None)  # it was not given a quarter
    assert "> 2 CPU s of 200" in found["text"]
    assert "not reached in 2 of 2 cells" in found["text"]


def test_costs_are_compared_over_the_same_cells():
    fast = history((0, 10), (20, 26))
    found = cost_claim({"one": fast})  # 'two' is not there: 20 of 100, not of 200
    assert found["value"] == pytest.approx(0.2)


def test_a_row_that_no_other_cell_meets_has_no_cost():
    doc = table([cell("one", "plain@mid", 20.0), cell("one", "oracle", None)])
    assert cost_to_match(doc, "oracle", "plain@mid", "renders") is None
    assert "no curve" in page(doc)


def test_the_page_tells_failures_and_what_was_not_computed():
    cells = [*both(plain_at_mid=24.0, spikenerf_at_mid=29.0), cell("one", "oracle", None), cell("two", "oracle", 33.0)]
    text = page(table(cells))
    assert "| `plain@mid` | 25.50 | 24.50 | 0.9000 | 0.9000 | not computed | not computed | 100 |" in text
    assert "`oracle` (1 of 2 scenes)" in text
    assert "| `oracle` | failed: fit: training \\| diverged |" in text
    assert "`oracle` on `one`, seed 0: failed" in text
    assert "holds by 1.00 dB" in text
    rows = [line for line in text.partition("## What equal dB cost")[0].splitlines() if line.startswith("|")]
    assert len(rows) == 3 * 5
    assert {line.replace("\\|", "").count("|") for line in rows} == {14}
    assert "> 20.0, not reached" in page(table(both(plain_at_mid=24.0, bad=20.0)))


def test_curves_of_any_cells_are_drawn():
    data = curves(table([*both(plain_at_mid=24.0), cell("one", "oracle", None)]))
    assert b"<svg" in data
    assert data == curves(table([*both(plain_at_mid=24.0), cell("one", "oracle", None)]))


def test_the_liveliest_square():
    picture = np.zeros((50, 80, 3), np.uint8)
    picture[30:40, 60:70] = np.random.default_rng(0).integers(0, 255, (10, 10, 3))
    rows, columns = liveliest(picture, 16)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (16, 16)
    assert rows.start <= 30
    assert rows.stop >= 40
    assert columns.start <= 60
    assert columns.stop >= 70
    assert liveliest(picture, 64)[0] == slice(0, 50)
    assert liveliest(np.zeros((8, 8, 3), np.uint8), 64) == (slice(0, 8), slice(0, 8))
