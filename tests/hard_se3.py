# ruff: noqa: E501
"""Hard cases of rigid motions with gradients, and of optimised paths."""

SE3, PATH = "numerics/test_se3.py::test_", "train/test_path.py::test_"

ROWS = [
    ("turns of 0, 1e-300 ... 1e-2, both sides of every branch, pi - 1e-12", "log_se3", "undoes exp_se3 to 1e-13", SE3 + "log_undoes_exp_to_1e_12"),
    ("half turns about any axis", "log_se3", "round trip to 1e-12 with either sign", SE3 + "half_turns_round_trip_with_either_sign"),
    ("turns of 0 to 40 radians", "exp_se3", "the matrix exponential, 1e-12", SE3 + "exp_is_the_matrix_exponential"),
    ("exactly the identity", "exp_se3, log_se3", "the exact gradient, to the bit", SE3 + "gradients_at_the_identity_are_exact"),
    ("exactly pi, beyond pi, 2 pi, float32", "exp_se3, log_se3", "finite gradients", SE3 + "gradients_are_finite_everywhere"),
    ("both sides of every branch, and on it", "exp_se3, log_se3", "gradients agree with differences", SE3 + "gradients_agree_with_differences_on_both_sides_of_the_kinks"),
    ("0 and pi in one batch", "exp_se3, log_se3", "the gradients of each alone", SE3 + "small_and_large_motions_in_one_batch_are_as_alone"),
    ("equal knots, all knots 0", "linear_spline, cubic_spline", "stands still, gradients agree with differences", SE3 + "splines_of_equal_knots_stand_still_and_gradients_pass"),
    ("where two pieces meet", "cubic_spline", "two derivatives are continuous", SE3 + "a_cubic_spline_is_smooth_where_pieces_meet"),
    ("one training view", "train fit with a path", "its middle stays, the curve is finite", PATH + "one_training_view_has_a_path_too"),
    ("one camera, cameras at one place", "gauge_directions", "fewer directions, all finite", PATH + "the_directions_of_the_gauge_are_motions_that_change_no_picture"),
    ("a scene without trajectories", "load_targets", "a start of 3 px a view; DataError without a path", PATH + "without_a_trajectory_a_path_is_learned_and_without_a_path_refused"),
    ("gradients of 1e-40", "path.descend", "finite knots", PATH + "a_gradient_too_small_to_square_moves_nothing_to_nan"),
    ("cut at a step and resumed, 1 and 3 threads", "train fit with a path", "the same model and cameras to the bit", PATH + "same_bits_for_any_thread_count_and_resumed"),
]  # fmt: skip
