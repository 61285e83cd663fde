# ruff: noqa: E501
"""Hard cases of losses, metrics, trajectories and the fit."""

LOSSES, METRICS = "numerics/test_losses.py::test_", "numerics/test_metrics.py::test_"
FIT, TARGETS = "train/test_fit.py::test_", "train/test_targets.py::test_"
GRAY, START, PATHS = "train/test_gray.py::test_", "train/test_start.py::test_", "train/test_trajectory.py::test_"
FILES, SCORE, MCMC = "train/test_files.py::test_", "train/test_score.py::test_", "train/test_densify.py::test_"

ROWS = [
    ("black, the kink of sRGB, beyond white", "tfs_loss", "agrees with float64 to 3e-6", LOSSES + "tfs_matches_its_definition"),
    ("the same", "average_exposure", "agrees with float64, each gradient too", LOSSES + "average_matches_its_definition"),
    ("black, 1e-9 of white", "srgb_from_linear", "finite gradient, round trip", LOSSES + "curves_are_inverse_and_their_gradients_finite_at_black"),
    ("NaN under the mask", "tfs_loss", "the same bits as without, gradient 0", LOSSES + "masked_pixels_may_hold_anything"),
    ("nothing known", "tfs_loss", "0, gradient 0", LOSSES + "nothing_known_is_a_zero_loss"),
    ("1, 2, 3 threads", "tfs_loss, average_exposure", "the same bits", LOSSES + "same_bits_for_any_thread_count"),
    ("texture 0, mean 0, ratio 1e6", "ratio_target", "bounded, in [0, 1]", LOSSES + "ratio_of_equal_textures_returns_the_frame_and_extremes_are_bounded"),
    ("equal pictures", "psnr", "infinity, null in JSON", METRICS + "psnr_by_hand"),
    ("flat pictures", "ssim", "1 where equal, finite else", METRICS + "ssim_of_equal_pictures_is_one_even_where_flat"),
    ("NaN, below 0, above 1", "rounded", "0, 0, 255", METRICS + "rounding_is_part_of_the_protocol"),
    ("smaller than the window", "ssim", "UsageError", METRICS + "wrong_pictures_are_told"),
    ("turns of 0, 1e-12, pi - 1e-9", "exp_se3, log_se3", "round trip to 1e-12", PATHS + "exp_and_log_are_inverse"),
    ("half turns about any axis", "rotation_vector", "round trip to 1e-12 with either sign", PATHS + "half_turns_round_trip_with_either_sign"),
    ("an instant at a knot", "pose_at", "the knot's pose to the bit", PATHS + "knots_are_exact_and_the_middle_of_a_turn_is_half_of_it"),
    ("an instant far outside, one pose only", "pose_at", "DataError", PATHS + "an_instant_far_outside_is_refused_and_half_a_spacing_is_not"),
    ("a colourless scene", "gray.solve", "Rec.601 by a ridge", GRAY + "a_colourless_scene_falls_back_to_rec601_times_the_gain"),
    ("saturated pixels", "gray.Pairs", "left out", GRAY + "clipped_pixels_are_left_out"),
    ("a black scene, spikes of another scene", "gray.solve", "DataError", GRAY + "a_black_scene_and_foreign_spikes_are_told"),
    ("one point, coincident points", "spacing", "finite", START + "spacing_of_awkward_points"),
    ("no points", "start_splats", "DataError; random only when asked", START + "no_points_is_an_error_unless_random_ones_are_asked_for"),
    ("one camera, NaN points", "gauge_of", "DataError", START + "a_scene_without_extent_is_told"),
    ("pixels that never fire, pixels not valid", "load_targets", "no weight", TARGETS + "unknown_and_invalid_pixels_carry_no_weight"),
    ("spikes on a clock without a map", "spike_tick", "DataError", TARGETS + "spikes_on_another_clock_are_mapped_or_refused"),
    ("no spikes", "load_targets", "DataError for spike methods, plain runs", TARGETS + "what_a_method_lacks_is_told"),
    ("no trajectory, no truth, no training views", "load_targets", "DataError", TARGETS + "no_trajectory_no_truth_no_training_views"),
    ("spikes shorter than the exposure", "exposure_mean", "DataError", TARGETS + "spikes_that_end_before_the_exposure_are_told"),
    ("a rolling shutter", "load_targets", "middle row, and said so", TARGETS + "a_rolling_shutter_is_remarked"),
    ("a NaN pixel", "train", "NumericsError: step, view", FIT + "a_target_that_is_not_finite_is_told_by_step_and_view"),
    ("infinity between two looks of the loop", "guard.find", "the very step, tensor and index; the state before it kept", "train/test_guard.py::test_the_first_step_that_broke_is_found_not_the_look_that_saw_it"),
    ("a failure that does not come again", "guard.reproducer", "told, with the last finite state", "train/test_guard.py::test_a_failure_that_does_not_come_again_is_told_as_such"),
    ("weights that overflow", "train diverged", "exit 5 and a reproducer; taken again, exit 1", "train/test_guard.py::test_the_command_takes_the_step_again"),
    ("a scene that is black, saturated, of one view, of cameras in one place, without one spike, without spikes, with nothing valid", "train fit", "a clear message or a finite model, on splats and nerf-fast", "train/test_hostile.py::test_a_hostile_scene_ends_in_a_clear_message_or_a_sane_model"),
    ("black or saturated spikes, gain known", "train fit --gray rec601", "a finite model", "train/test_hostile.py::test_with_a_known_gain_spikes_that_say_nothing_still_train"),
    ("NaN, infinity in the truth", "write_scene, load_targets", "NumericsError: view, index", "train/test_hostile.py::test_a_pixel_of_the_truth_that_is_not_finite_is_refused_when_written_and_when_read"),
    ("an infinite parameter", "check_finite", "NumericsError: step, tensor, index", FIT + "a_broken_parameter_is_told_by_name_and_index"),
    ("learning rates of 9e5", "train", "a finite model or NumericsError", FIT + "hostile_rates_end_in_a_model_or_a_clear_error"),
    ("1, 2, 3 threads", "train", "the same model to the bit", FIT + "same_bits_for_any_thread_count"),
    ("kill -9 and --resume", "train fit", "the same model to the bit", FIT + "killed_and_resumed_is_as_if_never_killed"),
    ("nothing alive", "relocate", "nothing changes", MCMC + "growth_is_five_per_cent_up_to_the_cap_and_nothing_alive_changes_nothing"),
    ("quaternion 0", "rotations", "the identity", MCMC + "rotations_of_any_quaternion_are_rotations"),
    ("cut off, foreign, NaN, a huge count", "import_ply", "DataError", FILES + "a_damaged_ply_is_told"),
    ("cut off, foreign, empty", "checkpoint.load", "DataError", FILES + "checkpoint_round_trip_and_refusals"),
    ("no truth; no held-out views either", "score_run", "stored frames, said so; DataError", SCORE + "without_truth_the_stored_frames_are_scored_and_named"),
]  # fmt: skip
