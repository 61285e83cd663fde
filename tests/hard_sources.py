"""Hard inputs of the places light comes from."""

VIDEO, RETAKE, EXR = "rigctl/test_video.py::", "rigctl/test_retake.py::", "dataset/test_exr.py::"
FRAMES, MITSUBA, BLENDER = "rigctl/test_frames.py::", "rigctl/test_mitsuba.py::", "rigctl/test_blender_script.py::"
ROWS = [
    (
        "47 awkward EXR files",
        "read_image",
        "the display window's size and finite light, or an error that says why",
        EXR + "test_awkward_exr_files_are_read_or_refused",
    ),
    (
        "data window != display window, apart, beyond, within",
        "read_exr",
        "every pixel where the display window has it, black elsewhere",
        EXR + "test_one_picture_on_many_windows",
    ),
    (
        "luminance with subsampled chroma, XYZ primaries",
        "read_exr",
        "the same photograph as RGB, to half floats; chroma to 36 dB",
        EXR + "test_one_picture_in_four_encodings",
    ),
    (
        "channels of different sample types",
        "read_exr",
        "each as it is",
        EXR + "test_sample_types_may_differ_between_channels",
    ),
    (
        "a normal pass with a channel Y",
        "read_exr",
        "no picture, no depth",
        EXR + "test_a_vector_is_neither_gray_nor_depth",
    ),
    (
        "NaN, infinite, negative light in pictures, mended",
        "sim frames",
        "the bits of a picture that held the mended values; all counted",
        FRAMES + "test_bad_values_are_mended_counted_and_reported",
    ),
    ("a picture without one good value", "mend", "zero, counted", FRAMES + "test_mending_a_picture_of_nothing_good"),
    (
        "variable frame rate",
        "sim spikes",
        "the frames' own times, exactly",
        VIDEO + "test_true_times_of_a_variable_frame_rate",
    ),
    (
        "frames that go back in time or change size",
        "sim spikes",
        "left out and counted; DataError",
        VIDEO + "test_frames_that_do_not_go_on_in_time_are_left_out",
    ),
    (
        "a video cut at every twentieth, or with wrong bytes",
        "open_video",
        "DataError with how far it is whole, or frames; never a crash",
        VIDEO + "test_truncated_and_corrupt_videos",
    ),
    (
        "a video that is a list of other files",
        "open_video",
        "DataError; nothing else is opened",
        VIDEO + "test_a_list_cannot_make_it_open_another_file",
    ),
    (
        "light of five thresholds a tick from pictures",
        "spikes_of",
        "a spike every tick, the share clipped",
        RETAKE + "test_saturated_light_is_counted",
    ),
    (
        "a limit between two pictures",
        "knots",
        "cut there, light interpolated",
        RETAKE + "test_a_limit_cuts_between_pictures",
    ),
    (
        "an interrupt in the middle of a file",
        "sim spikes",
        "exit 130, nothing left behind",
        RETAKE + "test_an_interrupt_leaves_nothing_half",
    ),
    (
        "a renderer that aborts, hangs or runs out of memory",
        "sim mitsuba",
        "HostError with the likeliest cause",
        MITSUBA + "test_a_child_that_dies_or_is_too_slow",
    ),
    (
        "a rendering killed half-way",
        "sim mitsuba",
        "goes on; the scene's bits as if it had not been",
        MITSUBA + "test_a_run_cut_short_goes_on",
    ),
    (
        "a Blender killed half-way through a file",
        "render_rs3d.py",
        "goes on, with the same seeds",
        BLENDER + "test_a_dry_run_and_a_run_cut_short",
    ),
]
