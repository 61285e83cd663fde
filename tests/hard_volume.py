"""Hard cases of volume rendering, open space and rolling shutters."""

VOLUME, ROLLING, FIT = "numerics/test_volume.py::test_", "train/test_rolling.py::test_", "train/test_nerf.py::test_"

ROWS = [
    (
        "optical depth 1e-12 to 1e3, both sides of the clamp at 80",
        "weights_of",
        "alpha to 4 units in the last place, gradient e^-x times length",
        VOLUME + "alpha_and_its_gradient_from_thin_to_opaque",
    ),
    (
        "10,000 samples, depth 1e-6 to 1e4",
        "weights_of",
        "weights and what is left sum to 1 within 1e-6; agrees with float64",
        VOLUME + "ten_thousand_samples_lose_no_light",
    ),
    (
        "alpha exactly 1, within and beyond the clamp",
        "weights_of",
        "gradcheck in float64, finite",
        VOLUME + "gradients_where_alpha_is_one_exactly",
    ),
    (
        "density bias -1e4 to 3e38",
        "network (nerf)",
        "finite and not negative, finite gradient",
        VOLUME + "the_papers_density_at_any_bias",
    ),
    (
        "log density -1e4 to 1e4, both sides of the flat part",
        "density_of (nerf-fast)",
        "finite; a way back from beyond the flat part",
        VOLUME + "the_fast_fields_density_at_any_bias",
    ),
    (
        "lengths 1e-12 to 1e12, beside 1",
        "contract",
        "agrees with float64, shorter than 2",
        VOLUME + "contraction_is_its_definition_inside_and_far_outside",
    ),
    (
        "lengths 1e-12 to 1e12, both sides of the kink",
        "contract, its gradient",
        "the closed form within 1e-14; gradcheck",
        VOLUME + "contractions_jacobian_is_the_closed_form",
    ),
    (
        "0, infinity, 3e38, NaN",
        "contract",
        "0, the rim, the rim, NaN; finite gradients",
        VOLUME + "contraction_at_zero_and_infinity",
    ),
    (
        "contracted distance 2",
        "distance_of",
        "finite, beyond 1e6, increasing",
        VOLUME + "contracted_distances_reach_far_and_never_turn_back",
    ),
    (
        "density beyond every box only",
        "place, trace_hashed",
        "samples go there; finite",
        VOLUME + "an_open_field_sees_beyond_every_box",
    ),
    ("all points outside the box", "prime", "changes nothing", FIT + "points_outside_the_box_teach_nothing"),
    (
        "a read-out of nearly an exposure",
        "row_poses, poses_at",
        "each pixel's own pose within 5e-5",
        ROLLING + "every_pixel_has_the_pose_of_its_own_instant",
    ),
    (
        "no read-out, no poses over it",
        "late_of",
        "None: the middle row's pose for all",
        ROLLING + "a_global_shutter_has_no_lateness",
    ),
    (
        "a read-out of nearly an exposure",
        "textures_by_row",
        "agrees with calib's, row by row",
        ROLLING + "textures_follow_the_rows",
    ),
]
