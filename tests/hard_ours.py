"""Hard cases of `ours`: restored instants, arms that moved, light above white."""

RESTORE, ARMS, OVER = "train/test_restore.py::test_", "train/test_arms.py::test_", "train/test_overexposure.py::test_"

ROWS = [
    ("a pixel that never fires", "intervals_at", "not known", RESTORE + "a_pixel_without_an_interval_is_not_known"),
    (
        "nothing known of any pixel",
        "restored",
        "the frame",
        RESTORE + "unknown_pixels_take_the_frame_s_word",
    ),
    (
        "an interval longer than the instant, outside the exposure",
        "covered",
        "the mean of the instants it covers; the outer ones go on",
        RESTORE + "an_interval_is_the_mean_of_what_it_covers",
    ),
    (
        "a frame at its end everywhere",
        "restored",
        "the spikes' light, above white",
        RESTORE + "light_above_white_is_kept_or_clipped",
    ),
    (
        "a model that explains frame and spikes",
        "restored",
        "its own render",
        RESTORE + "a_model_that_explains_everything_is_left_alone",
    ),
    (
        "rolling shutter under a field of rays",
        "restore.read",
        "DataError",
        RESTORE + "a_rolling_shutter_under_rays_is_refused",
    ),
    ("no texture, no pixels, 18 px", "motion_of", "DataError", ARMS + "no_texture_and_too_far_are_told"),
    (
        "a picture with nothing above white",
        "looks",
        "DataError",
        OVER + "a_scene_without_highlights_is_refused",
    ),
]
