"""Hard inputs of the calibration: lenses, boards, rigs; and the rows that say what must come out."""

import numpy as np

LENSES = {
    "none": np.zeros(0),
    "all zero": np.zeros(4),
    "barrel": np.array([-0.28, 0.06, 1e-3, -2e-3]),
    "pincushion": np.array([0.2, 0.1, 0, 0, 0.05]),
    "folding": np.array([-0.6, 0, 0, 0]),
    "rational, wide": np.array([0.4, 0.1, 1e-4, 5e-4, 0.02, 0.7, 0.2, 0.05]),
}


def bad_records() -> dict[str, bytes]:
    """Files that claim to be calibrations."""
    import json

    from calib_rigs import rig

    from spikerig.calib.rig import as_json

    good = as_json(rig())
    K = good["spike"]["K"]

    def but(**changes: object) -> bytes:
        return json.dumps({**good, **changes}).encode()

    return {
        "empty": b"",
        "no JSON": b"calibration",
        "not UTF-8": b"\xff\xfe{}",
        "a list": b"[]",
        "another schema": but(schema="spikerig.calibration/2"),
        "no schema": json.dumps({k: v for k, v in good.items() if k != "schema"}).encode(),
        "nested a hundred thousand deep": b"[" * 100_000,
        "a NaN": but().replace(b"620.0", b"NaN"),
        "an infinity": but().replace(b"620.0", b"1e999"),
        "an integer of 5000 digits": but(residual_px=1).replace(b'"residual_px": 1', b'"residual_px": 1' + b"0" * 5000),
        "10 MB": but() + b" " * 10_000_000,
        "a picture of no pixels": but(spike={**good["spike"], "width": 0}),
        "a picture of 10^12 pixels": but(spike={**good["spike"], "width": 10**12}),
        "a width that is no integer": but(spike={**good["spike"], "width": 400.5}),
        "a camera with a text in it": but(spike={**good["spike"], "K": [["620", 0, 0], *K[1:]]}),
        "a ragged matrix": but(spike={**good["spike"], "K": [[1, 2], *K[1:]]}),
        "a mirrored camera": but(spike={**good["spike"], "K": [[-620, 0, 200], *K[1:]]}),
        "seven coefficients": but(spike={**good["spike"], "distortion": [0.1] * 7}),
        "a million coefficients": but(spike={**good["spike"], "distortion": [0] * 1_000_000}),
        "a step that is no rotation": but(spike_from_rgb=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]),
        "a step with nothing in it": but(spike_from_rgb=None),
        "one centre and a baseline": but(spike_from_rgb=[[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0]]),
        "depths that are none": but(depth_mm=[1]),
        "booleans for numbers": but(residual_px=True),
        "a list for a name": but(mirrored=["rgb"]),
        "standard deviations that are texts": but(sd={"spike.fx_px": "1"}),
        "unknown fields": but(colour="red"),
        "a response of two": but(response=[1, 2]),
    }


_L = "calib/test_lens.py"
ROWS: list[tuple[str, str, str, str]] = [
    ("all of `LENSES`: none, folding, rational", "project, directions", "OpenCV's pixels + 0.5, each other's inverse",
     f"{_L}::test_directions_undo_project_wherever_the_lens_reaches"),
    ("a polynomial lens beyond its fold", "project, directions", "NaN, not a pixel inside the picture",
     f"{_L}::test_a_lens_that_folds_is_not_followed_beyond_its_fold"),
    ("all of `bad_records`: not JSON, NaN, 5000 digits, nested deeply, matrices that are none", "read_calibration",
     "one DataError", "calib/test_rig.py::test_hostile_records_end_in_one_error"),
    ("boards that do not tilt at all", "solve, fit_arms", "a huge variance, no exception; refused",
     "calib/test_optics.py::test_boards_that_barely_tilt_are_refused_however_small_the_residual"),
    ("an arm mirrored, labels turned at random", "fit_arms", "the rig, to a tenth of a pixel",
     "calib/test_optics.py::test_a_rig_is_found_whatever_its_mirror_and_labels"),
    ("pairs shot at different instants, or shifted by one", "measure", "refused, in both parities",
     "calib/test_optics.py::test_pairs_shot_at_different_instants_are_refused_in_both_parities"),
    ("the same pictures twice, three views, another pattern", "measure", "all these faults at once",
     "calib/test_optics.py::test_all_faults_of_the_views_at_once"),
    ("part of a larger board found as if it were the whole", "measure", "refused, the pattern seen is named",
     "calib/test_optics.py::test_all_faults_of_the_views_at_once"),
    ("a board at rest for several views", "measure", "counted as one view",
     "calib/test_optics.py::test_a_board_that_has_not_moved_is_one_view"),
    ("a misread corner, a hidden corner, noise for a picture, a blank one", "refine, fit_lens",
     "left out, or left where it was; never NaN", "calib/test_boards.py::"
     "test_refinement_survives_a_start_that_is_off_and_leaves_what_it_cannot_fit"),
    ("edges along the pixel grid, as sharp as pixels allow", "find", "corners to 0.015 px",
     "calib/test_boards.py::test_corners_of_clean_light_are_exact"),
    ("stripes finer than a spike pixel", "warp_light", "an even gray, no moire",
     "calib/test_align.py::test_the_prefilter_takes_out_what_spike_pixels_cannot_show"),
    ("exposures that leave the stream, lost ticks", "exposure_texture, windows_at", "not known there",
     "calib/test_align.py::test_rolling_exposures_see_what_each_row_saw"),
    ("no edges, nothing valid, edges in one direction", "edge_agreement", "NaN, or no shift along the edge",
     "calib/test_align.py::test_edges_tell_a_known_shift"),
    ("dead, stuck, hot and saturated pixels", "flat_field", "not good, and out of all means",
     "calib/test_photometric.py::test_maps_of_a_known_sensor_come_back"),
    ("everything dark, everything saturated, no dark recording", "flat_field", "DataError or UsageError",
     "calib/test_photometric.py::test_saturated_pixels_and_levels_do_not_count"),
    ("maps that are objects, NaN, of two sizes, no archive", "read_flat", "one DataError; nothing unpickled",
     "calib/test_photometric.py::test_maps_that_are_none"),
    ("interrupted while writing in place", "write_aligned", "the old scene to the last byte, nothing beside",
     "calib/test_align_cli.py::test_in_place_only_when_whole"),
    ("empty folders, text for pictures, one pixel, 10 gigapixels claimed, other geometries, names that do not match",
     "calib board", "one error of exit 2 or 4, no traceback, nothing written",
     "calib/test_board_refusals.py::test_hostile_folders"),
    ("a board that curls by 2 mm, or by 6", "calib board", "refused: loose-crop, bad-corners",
     "calib/test_board_refusals.py::test_every_refusal"),
    ("both arms in a mirror, the spike arm alone in one", "measure", "the crop of raw pixels holds",
     "calib/test_optics.py::test_a_charuco_board_says_which_arm_is_mirrored"),
    ("lamps too fast to see, steady ones, edges that shake, a room that blinks, lost ticks", "blinking_regions",
     "the slow lamps' hull and nothing else", "calib/test_regions.py::test_lamps_are_found_and_scenes_are_not"),
    ("rectangles of no area, NaN, regions of another mode", "panel_of, check_regions", "UsageError",
     "calib/test_regions.py::test_rectangles_and_files"),
    ("maps of another sensor, of a file that is none", "data texture --flat", "exit 2 or 4, nothing written",
     "dataset/test_data_cli.py::test_a_texture_is_evened_out_on_request"),
    ("no view in common", "fit_arms", "NumericsError", "calib/test_optics.py::test_no_view_in_common_is_said"),
]  # fmt: skip
