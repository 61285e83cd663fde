# ruff: noqa: E501
"""Hard cases of measuring: metrics, sharpness, trained judges, loose pictures, scores across worlds."""

SHARP, LOOSE = "numerics/test_quality.py::test_", "train/test_quality.py::test_"
WORLDS = "train/test_worlds.py::test_"

ROWS = [
    ("NaN, infinity; no pixels", "psnr, ssim, luma_psnr, chroma_psnr", "NumericsError with the count; UsageError", SHARP + "metrics_refuse_nan_and_nothing"),
    ("one pixel, light of 4.5", "psnr", "the number, not clipped; SSIM refuses", SHARP + "hdr_pictures_compare_unclipped_and_one_pixel_is_enough_for_psnr"),
    ("an error of 1e-9", "psnr", "180 dB to 1e-4; OpenCV's value on 8 bits to 1e-9", SHARP + "psnr_keeps_its_digits_on_tiny_errors_and_against_opencv"),
    ("pictures narrower than the 11 taps", "crete_blur", "scikit-image's value to 1e-12", SHARP + "crete_gives_the_librarys_values"),
    ("a ramp, a mirrored edge", "sobel, tenengrad", "the slope; SciPy's value to 1e-14", SHARP + "sobel_matches_scipy_and_a_ramp_has_its_slope"),
    ("white noise, noise on a plane", "noise_sigma, laplacian_over_noise", "sigma to 1 %, blind to the plane; 1", SHARP + "noise_is_found_and_alone_gives_one"),
    ("flat at 0, 128, 255", "sharpness", "finite; blur 1; null where noise is 0", SHARP + "flat_pictures_have_finite_measures_and_say_so"),
    ("one and two 8-bit steps of contrast", "flat_share", "flat and not", SHARP + "flat_share_counts_squares_on_both_sides_of_a_step"),
    ("1x1, 2x50, 3x3", "sharpness", "null with a remark", SHARP + "tiny_pictures_are_null_with_a_remark"),
    ("NaN; two axes; no rows", "luma", "NumericsError; UsageError", SHARP + "nan_and_foreign_shapes_are_told"),
    ("flat, mostly flat, 15 rows", "Brisque", "null, flagged, null: each with its reason", LOOSE + "brisque_of_flat_and_tiny_pictures_is_withheld_and_of_half_flat_ones_flagged"),
    ("empty, cut, swapped, 35 features, other floats, not text", "open_brisque", "DataError naming both files", LOOSE + "damaged_brisque_files_are_told_both_at_once"),
    ("equal pictures", "train quality", "psnr null, and why", LOOSE + "references_are_matched_by_stem_and_equal_pictures_are_null_with_a_reason"),
    ("cut PNG and GIF, text, a 65535x65535 GIF, NaN, missing", "train quality", "one error with all of them", LOOSE + "all_faults_are_told_at_once"),
    ("light below 0 and above 1, 16 bits, gray, alpha", "read_codes", "codes, clipped share told; alpha needs a background", LOOSE + "hdr_sixteen_bits_gray_and_alpha_become_codes"),
    ("TorchScript without --trust", "open_lpips, open_rankiqa", "UsageError, nothing runs", LOOSE + "torchscript_runs_only_when_trusted"),
    ("a network with d(x, x) > 0, with other inputs, rubbish", "open_lpips, open_rankiqa", "DataError", LOOSE + "a_network_that_is_no_distance_is_refused"),
    ("weights missing, NaN; 20 pixels", "open_lpips", "DataError; UsageError", LOOSE + "lpips_from_safetensors_is_its_definition"),
    ("224 and 223 pixels", "crops", "one crop; UsageError", LOOSE + "rankiqa_sees_its_crops_in_bgr"),
    ("another world: turned, moved, scaled", "score_run", "the same scores to 1e-3 dB", WORLDS + "another_world_is_brought_over_and_gives_the_same_scores"),
    ("held-out poses off", "bridge", "the same similarity to the bit", WORLDS + "held_out_cameras_take_no_part_in_the_similarity"),
    ("none, one, two cameras in common; all at one place", "bridge", "same world assumed, or DataError", WORLDS + "bridge_refuses_what_cannot_be_fitted"),
    ("exact poses that differ by 1e-4", "bridge", "told, not fitted away", WORLDS + "small_differences_of_exact_poses_are_told_not_fitted"),
    ("already best, a black picture, nothing in sight", "realign", "never worse than it began; no move without a gradient", WORLDS + "alignment_finds_a_camera_and_never_ends_worse"),
    ("a model that draws NaN", "realign", "NumericsError", WORLDS + "alignment_of_a_broken_model_is_told"),
    ("run.json with cameras that are none", "train score", "DataError", WORLDS + "cameras_that_a_run_moved_are_its_world_and_damaged_ones_are_told"),
    ("a render equal to its truth", "grade", "infinite PSNR, remarked", WORLDS + "equal_pictures_are_graded"),
]  # fmt: skip
