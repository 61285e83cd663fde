"""Hard cases of the fields of rays."""

RAYS, FIT, CONFIG = "numerics/test_rays.py::test_", "train/test_nerf.py::test_", "train/test_config.py::test_"

ROWS = [
    (
        "points on faces and vertices, at 1, outside",
        "hash_encode",
        "agrees with float64",
        RAYS + "hash_encode_matches_its_definition",
    ),
    (
        "hashed levels, rows no point touches",
        "hash_encode backward",
        "agrees with float64; exactly 0 where untouched",
        RAYS + "the_grids_gradient_matches_torch_in_float64",
    ),
    (
        "1, 2, 3, 5 threads",
        "hash_encode, forward and backward",
        "the same bits",
        RAYS + "the_grid_has_the_same_bits_for_any_thread_count",
    ),
    (
        "NaN, infinity, no points",
        "hash_encode",
        "the clamped corner; an empty result",
        RAYS + "points_that_are_no_numbers_are_the_corner_and_none_are_none",
    ),
    (
        "a table of another grid, levels out of range",
        "hash_encode, layout_of",
        "UsageError",
        RAYS + "grids_that_do_not_fit_are_refused",
    ),
    (
        "density 0, 1e-30, 3e38; 1 and 10,000 samples",
        "weights_of",
        "weights and the rest sum to 1, gradients finite",
        RAYS + "weights_at_their_limits_sum_to_one_with_finite_gradients",
    ),
    (
        "optical depth 1e-12",
        "weights_of",
        "relative error below 2e-7",
        RAYS + "a_thin_samples_weight_is_exact_to_float32",
    ),
    ("density 0 to 60", "composite", "gradcheck in float64", RAYS + "gradients_of_composite"),
    (
        "no density, density 1e9",
        "composite",
        "the background; the wall's colour and depth",
        RAYS + "composite_of_nothing_is_the_background_and_of_a_wall_its_colour",
    ),
    ("weights all 0, 1e-38, 1e38", "inverse_cdf", "even samples", RAYS + "samples_of_weights_without_shape_are_even"),
    (
        "pieces of weight 0, shares 0 and 1",
        "inverse_cdf",
        "never inside them",
        RAYS + "samples_follow_the_weight_and_avoid_the_empty",
    ),
    (
        "a ray beside the box, along an axis",
        "bounds",
        "a span of 0; finite",
        RAYS + "a_ray_that_misses_the_box_or_runs_along_an_axis",
    ),
    (
        "an empty occupancy grid",
        "trace_hashed",
        "the background, gradient 0",
        RAYS + "an_empty_grid_shows_the_background_with_no_gradient",
    ),
    (
        "one cell full",
        "place",
        "every sample in it, its length only",
        RAYS + "samples_stay_in_the_one_full_cell_and_stand_for_its_length",
    ),
    (
        "every weight of the networks",
        "trace_hashed",
        "gradcheck in float64",
        RAYS + "gradients_of_the_fast_field",
    ),
    (
        "log density 500",
        "density_of",
        "finite, with a gradient that leads back",
        RAYS + "a_density_beyond_all_bounds_is_finite_and_can_come_back",
    ),
    (
        "black frames, no light in the spikes",
        "run_fit (nerf-fast)",
        "goes black, finite",
        FIT + "a_black_scene_goes_black",
    ),
    ("one training view", "run_fit (nerf, nerf-fast)", "trains", FIT + "one_view_trains"),
    (
        "a NaN in a parameter",
        "one_step",
        "NumericsError with step, tensor, index",
        FIT + "a_number_that_is_none_is_told_with_step_tensor_and_index",
    ),
    ("a NaN in a target", "one_step", "NumericsError with step and view", FIT + "a_target_that_is_no_number_is_told"),
    (
        "1, 2, 3 threads",
        "run_fit (nerf-fast)",
        "the same bits, occupancy too",
        FIT + "the_fast_field_has_the_same_bits_for_any_thread_count",
    ),
    (
        "a kill between two refreshes of the grid",
        "run_fit --resume",
        "the same bits as uninterrupted",
        FIT + "resumed_is_uninterrupted",
    ),
    (
        "SSIM on rays, remembered renders, a setting of another field",
        "configure",
        "UsageError",
        CONFIG + "what_a_field_cannot_do_is_refused",
    ),
]
