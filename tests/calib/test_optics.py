"""From corners to a rig: parity, labels, one centre or two, lenses, and when to refuse."""

import dataclasses

import numpy as np
import pytest
from calib_rigs import BOARD, corners_seen, crop_error_px, rig, seen_of

from spikerig.calib.boards import Board
from spikerig.calib.bundle import Sight
from spikerig.calib.crop import parallax_px, rgb_px_from_spike_px, spike_px_from_rgb_px
from spikerig.calib.measure import measure, report
from spikerig.calib.mono import fit_lens
from spikerig.calib.optics import fit_arms
from spikerig.calib.verdict import coverage, repeats
from spikerig.dataset.errors import NumericsError

VIEWS = 8


@pytest.mark.parametrize("mirrored", [None, "rgb"])
@pytest.mark.parametrize("shift", [(0, 0, 0), (15.0, -2.0, 3.0)])
def test_a_rig_is_found_whatever_its_mirror_and_labels(mirrored: str | None, shift: tuple[float, float, float]) -> None:
    true = rig(shift, mirrored)
    fit = fit_arms(BOARD, *corners_seen(true, VIEWS, shuffle=True), lenses=(4,))
    found = fit.calibration
    assert found.mirrored == mirrored
    assert found.model == true.model
    assert fit.match.agree.all()
    assert fit.other is not None
    assert fit.other.score > 10 * fit.match.score
    assert crop_error_px(found, true) < 0.15
    assert abs(found.baseline_mm - true.baseline_mm) < 5 * max(fit.sure.sd["baseline_mm"], 1e-9)
    assert found.spike.K[0, 0] == pytest.approx(620, abs=5 * fit.sure.sd["spike.fx_px"])
    assert found.rgb.K[0, 2] == pytest.approx(true.rgb.K[0, 2], abs=5 * fit.sure.sd["rgb.cx_px"])


def test_the_same_corners_give_the_same_record() -> None:
    assert len({fit_arms(BOARD, *corners_seen(rig(), 5), lenses=(4,)).calibration.id for _ in range(5)}) == 1


def test_the_user_may_say_that_the_spike_arm_is_the_mirrored_one() -> None:
    true = rig((0, 0, 0), "spike")
    sights = corners_seen(true, VIEWS, shuffle=True)
    told = fit_arms(BOARD, *sights, mirror="spike", lenses=(4,)).calibration
    assert told.mirrored == "spike"
    assert crop_error_px(told, true) < 0.15
    guessed = fit_arms(BOARD, *sights, lenses=(4,)).calibration  # a checkerboard cannot tell which arm it is
    assert guessed.mirrored == "rgb"
    assert crop_error_px(guessed, true) < 0.15


def test_square_patterns_are_labelled_in_four_ways() -> None:
    square = Board(6, 6, 16.0)
    assert square.turns == (0, 1, 2, 3)
    true = rig((5.0, 0, 0))
    some = np.arange(54).reshape(6, 9)[:, :6].ravel()
    first, second = (dataclasses.replace(s, px=s.px[:, some], seen=s.seen[:, some]) for s in corners_seen(true, VIEWS))
    for v in range(VIEWS):
        second.px[v] = square.relabelled(second.px[v], v % 4)
    fit = fit_arms(square, first, second, lenses=(4,))
    assert fit.match.agree.all()
    assert fit.calibration.baseline_mm == pytest.approx(5, abs=0.2)


def test_one_centre_is_given_up_for_parallax_and_only_for_it() -> None:
    kept = [fit_arms(BOARD, *corners_seen(rig(), VIEWS, noise_seed=k), lenses=(4,)) for k in range(4)]
    assert [f.calibration.model for f in kept] == ["common"] * 4
    assert all(f.calibration.baseline_mm == 0 for f in kept)
    true = rig((1.0, 0, 0))  # a splitter 1 mm off: 0.4 px over the depths seen
    fit = fit_arms(BOARD, *corners_seen(true, VIEWS), lenses=(4,))
    assert fit.calibration.model == "stereo"
    assert fit.chance < 1e-3
    assert fit.parallax_px == pytest.approx(parallax_px(true), rel=0.3)
    assert fit_arms(BOARD, *corners_seen(true, VIEWS), model="common", lenses=(4,)).calibration.model == "common"


def test_lens_coefficients_are_those_that_foretell_unseen_views() -> None:
    straight, bent = corners_seen(rig(lens=()), 10)[0], corners_seen(rig(), 10)[0]
    assert len(fit_lens(BOARD.points(), straight).fit.lenses[0][1]) == 0
    found = fit_lens(BOARD.points(), bent)
    assert len(found.fit.lenses[0][1]) in (1, 4)
    assert found.foretold_px[0] > 2 * found.foretold_px[4]
    few = fit_lens(BOARD.points(), dataclasses.replace(bent, px=bent.px[:5], seen=bent.seen[:5]))
    assert len(few.fit.lenses[0][1]) == 5
    assert few.foretold_px == {}


def test_a_misread_view_is_left_out() -> None:
    sight = corners_seen(rig(), 10)[0]
    px = sight.px.copy()
    px[3, 5] += [4, -3]
    found = fit_lens(BOARD.points(), dataclasses.replace(sight, px=px), (4,))
    assert found.odd.tolist() == [k == 3 for k in range(10)]
    assert found.fit.lenses[0][0][0, 0] == pytest.approx(620, abs=3)


def test_no_view_in_common_is_said() -> None:
    first, second = corners_seen(rig(), 6)
    first, second = (dataclasses.replace(s, seen=s.seen & side) for s, side in (
        (first, np.arange(6)[:, None] < 3), (second, np.arange(6)[:, None] >= 3)))  # fmt: skip
    with pytest.raises(NumericsError, match="both arms"):
        fit_arms(BOARD, first, second, lenses=(0,))


def codes(sights: tuple[Sight, Sight], **changes: object) -> list[str]:
    return report(measure(BOARD, seen_of(sights, **changes), lenses=(4,)))["reason_codes"]


def test_good_views_are_accepted_and_reported_in_full() -> None:
    told = report(measure(BOARD, seen_of(corners_seen(rig(), 10)), lenses=(4,)))
    assert told["accepted"] is True
    assert told["reasons"] == told["warnings"] == []
    assert told["views_used"] == 10
    assert told["fx_px"] == pytest.approx(620, abs=2)
    assert told["baseline_mm"] == 0
    assert told["rms_px"]["spike"] == pytest.approx(0.015 * np.sqrt(2), rel=0.1)
    assert told["rms_px"]["rgb"] == pytest.approx(0.03 * np.sqrt(2), rel=0.1)
    assert told["turn_deg"] == pytest.approx(np.linalg.norm([0.5, -1, 2]), abs=0.02)
    assert np.sum(told["coverage"]["spike"]) == 540
    assert max(abs(np.array(v["tilt_deg"])).max() for v in told["views"]) < 60
    assert all(v["without_it"]["crop_moves_px"] < 0.5 for v in told["views"])


@pytest.mark.parametrize("tilt_deg", [0.0, 0.5, 2.0])
def test_boards_that_barely_tilt_are_refused_however_small_the_residual(tilt_deg: float) -> None:
    told = report(measure(BOARD, seen_of(corners_seen(rig(), 10, tilt_deg=tilt_deg)), lenses=(4,)))
    assert "flat-boards" in told["reason_codes"]
    assert told["rms_px"]["spike"] < 0.15


def test_pairs_shot_at_different_instants_are_refused_in_both_parities() -> None:
    sights = corners_seen(rig(), VIEWS, jitter_mm=20)
    told = report(measure(BOARD, seen_of(sights), lenses=(4,)))
    assert told["reason_codes"] == ["not-one-rig"]
    assert set(told["parity_px"]) == {"plain", "mirrored"}
    assert "mirrored" in told["reasons"][0]
    assert told["rms_px"]["stereo"] > 20 * told["rms_px"]["rgb"]
    late = dataclasses.replace(sights[1], px=np.roll(corners_seen(rig(), VIEWS)[1].px, 1, axis=0))
    assert codes((sights[0], late)) == ["not-one-rig"]


def test_a_mirrored_arm_is_no_fault_unless_the_mirror_is_denied() -> None:
    sights = corners_seen(rig((0, 0, 0), "rgb"), VIEWS)
    told = report(measure(BOARD, seen_of(sights), lenses=(4,)))
    assert told["reason_codes"] == []
    assert told["mirror"] == {"parity": "measured", "arm": "convention"}
    assert any("by convention" in w for w in told["warnings"])
    given = report(measure(BOARD, seen_of(sights), mirror="rgb", lenses=(4,)))
    assert given["mirror"] == {"parity": "given", "arm": "given"}
    assert not any("convention" in w for w in given["warnings"])
    assert report(measure(BOARD, seen_of(sights), mirror="none", lenses=(4,)))["reason_codes"] == ["not-one-rig"]


@pytest.mark.parametrize("mirrored", [(False, False), (True, False), (False, True), (True, True)])
def test_a_charuco_board_says_which_arm_is_mirrored(mirrored: tuple[bool, bool]) -> None:
    board = Board(9, 6, 16.0, "DICT_5X5_100", 12.0)
    raw = [s.flipped() if flip else s for s, flip in zip(corners_seen(rig(), 6), mirrored, strict=True)]
    part = np.random.default_rng(0).random((6, 54)) < 0.8  # some of it hidden
    seen = seen_of((raw[0], dataclasses.replace(raw[1], seen=raw[1].seen & part)))
    told = measure(board, seen, mirrored, lenses=(4,))
    assert told.verdict.accepted, told.verdict.reasons
    assert told.fit is not None
    arm = {(True, False): "spike", (False, True): "rgb"}.get(mirrored)
    assert told.fit.calibration.mirrored == arm
    assert told.fit.other is None
    assert told.mirror == {"parity": "markers", "arm": "markers"}
    found = told.fit.calibration
    if all(mirrored):  # the world is mirrored instead, and pixels of both arms with it
        here = np.stack(np.meshgrid(np.linspace(0, 400, 9), np.linspace(0, 250, 7)), -1)
        want = rgb_px_from_spike_px(rig(), [400, 0] + [-1, 1] * here, 450.0)
        want[..., 0] = found.rgb.width - want[..., 0]
        back = spike_px_from_rgb_px(found, want, 450.0)
        assert np.nanmax(np.linalg.norm(back - here, axis=-1)) < 0.15
    else:
        assert crop_error_px(found, rig(mirrored=arm)) < 0.15


def test_odd_pairs_are_named() -> None:
    first, second = corners_seen(rig(), 10)
    px = second.px.copy()
    px[[2, 6]] = px[[6, 2]]
    measured = measure(BOARD, seen_of((first, dataclasses.replace(second, px=px))), lenses=(4,))
    ((code, text),) = measured.verdict.reasons
    assert code == "odd-pairs"
    assert "v02" in text
    assert "v06" in text
    assert "v03" not in text
    assert crop_error_px(measured.fit.calibration, rig()) < 0.1  # type: ignore[union-attr]


def test_all_faults_of_the_views_at_once() -> None:
    sights = corners_seen(rig(), 3)
    told = codes(sights, hashes=[("s", "r0"), ("s", "r1"), ("s2", "r2")], sizes=[])
    assert told == ["duplicates", "too-few-views"]
    blind = Sight(sights[0].px, np.zeros_like(sights[0].seen), 400, 250)
    assert codes((blind, sights[1]), sizes=[(7, 4), (4, 7)]) == ["wrong-pattern", "too-few-views"]
    part = codes(corners_seen(rig(), 6), sizes=[(11, 8), (8, 11)])  # a part of a larger board fits, and is not believed
    assert part == ["wrong-pattern"]


def test_a_board_that_has_not_moved_is_one_view() -> None:
    first, second = corners_seen(rig(), 6)
    pick = [0, 1, 0, 2, 3, 4, 1]
    again = [dataclasses.replace(s, px=s.px[pick] + 0.01, seen=s.seen[pick]) for s in (first, second)]
    again[0].px[2] = again[0].px[2][::-1]  # labelled the other way round
    seen = seen_of((again[0], again[1]))
    assert repeats(seen).tolist() == [-1, -1, 0, -1, -1, -1, 1]
    told = report(measure(BOARD, seen, lenses=(4,)))
    assert told["views_used"] == 5
    assert any("v02" in w and "v06" in w for w in told["warnings"])


def test_coverage_counts_corners_where_they_are() -> None:
    px = np.array([[[0.0, 0], [399.9, 249.9], [400, 250], [200, 10]]])
    told = coverage(Sight(px, np.array([[True, True, True, False]]), 400, 250))
    assert told[0, 0] == 1
    assert told[3, 4] == 2
    assert told.sum() == 3
