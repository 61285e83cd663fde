"""Hard cases of growth, absgrad, exposure correction and the rasteriser's thresholds."""

NUMERICS, GROW, EXPOSE = "numerics/test_splats.py::test_", "train/test_grow.py::test_", "train/test_exposure.py::test_"

ROWS = [
    (
        "needles, opaque stacks, splats across the camera plane and of any size",
        "render(absgrad=True)",
        "sums of absolute gradients agree with float64",
        NUMERICS + "absgrad_agrees_with_float64",
    ),
    (
        "pulls to both sides that cancel",
        "render(absgrad=True)",
        "signed gradient 0, absolute sum as by hand",
        NUMERICS + "absgrad_keeps_what_cancels",
    ),
    (
        "1, 2, 3, 5 threads",
        "render(absgrad=True)",
        "the same bits; other gradients as without it",
        NUMERICS + "absgrad_has_the_same_bits_for_any_thread_count_and_changes_no_other",
    ),
    (
        "alpha on either side of 1/255 and of 0.99",
        "render",
        "gradient as float64's by finite differences, 0 where cut or clipped",
        NUMERICS + "gradients_on_both_sides_of_a_kink",
    ),
    (
        "light left on either side of 1.1e-4",
        "render",
        "the next splat is drawn, or has gradient 0",
        NUMERICS + "the_last_light_on_both_sides",
    ),
    (
        "another end of the light, another clip of alpha",
        "render",
        "the comparison with float64 fails",
        NUMERICS + "the_band_comparison_sees_other_limits",
    ),
    (
        "pixels 3 to 3.3 sigma from a splat",
        "render",
        "drawn: nothing above 1/255 is culled",
        NUMERICS + "no_pixel_above_the_cut_is_culled",
    ),
    (
        "centres far outside the picture",
        "render",
        "as float64 without culling where splats are small",
        NUMERICS + "culling_loses_no_light_of_small_splats",
    ),
    (
        "log scales of +-3e38, quaternions of 1e-30 and 1e18",
        "render",
        "finite picture and gradients, agrees with float64",
        NUMERICS + "parameters_at_the_ends_of_float32",
    ),
    (
        "nobody saw a splat",
        "grow",
        "left alone",
        GROW + "what_nobody_saw_is_left_alone",
    ),
    (
        "all too faint or too large",
        "grow",
        "nothing dropped",
        GROW + "where_all_would_be_dropped_none_is",
    ),
    (
        "more candidates than room",
        "grow",
        "those of the largest gradient, ties by index",
        GROW + "the_cap_takes_the_largest_gradients_ties_by_index",
    ),
    (
        "a split splat of e^60 units",
        "grow",
        "finite places",
        GROW + "a_huge_splat_is_split_to_finite_places",
    ),
    (
        "1, 2, 3 threads; a resumed run",
        "train, densify = default",
        "the same model to the bit",
        GROW + "same_bits_for_any_thread_count_and_resumed",
    ),
    (
        "frames of gains 0.6 to 1.4",
        "train, exposure = affine",
        "held-out dB come back",
        EXPOSE + "gains_of_frames_are_found_and_the_dB_come_back",
    ),
    (
        "black and beyond-white pixels",
        "expose",
        "identity at the start, finite gradients",
        EXPOSE + "a_part_at_its_start_changes_nothing",
    ),
]
