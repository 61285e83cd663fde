"""Hard inputs of `data check`, of contact sheets, and of completing a scene in place."""

CHECK = "dataset/test_check.py::"
LIGHT = "calib/test_check_light.py::"
SHEET = "calib/test_pose_sheet.py::"
PLACE = "calib/test_in_place.py::"
ROWS = [
    (
        "NaN poses and rows, a missing pose, a flipped bit, times at 2^63, an unfinished file",
        "spikerig data check",
        "exit 1, a finding of the file; no other check falls over it",
        CHECK + "test_a_damaged_file_is_one_finding_and_nothing_falls_over_it",
    ),
    (
        "72 spoiled scenes, one or more for every check",
        "spikerig data check",
        "that check trips, with its importance",
        CHECK + "test_a_spoiled_scene_trips_its_check",
    ),
    (
        "a camera that stands still, no edges, no rate, other clocks, sizes, exposures outside the spikes",
        "spikerig data check",
        "undecided, and why",
        LIGHT + "test_what_cannot_be_decided_is_said",
    ),
    (
        "pictures late and misaligned at once",
        "calib.lag.lag_of",
        "the lag, to 2 ticks",
        LIGHT + "test_misaligned_pictures_do_not_look_late",
    ),
    (
        "a rolling shutter, a Bayer sensor, noise of every kind",
        "spikerig data check",
        "passes; the lag is below 1 tick",
        LIGHT + "test_good_scenes_of_hard_sensors_pass",
    ),
    (
        "a spike lens that distorts, in an aligned scene",
        "spikerig data check",
        "passes by the scene's calibration, fails without it",
        LIGHT + "test_an_aligned_scene_of_a_bent_spike_lens",
    ),
    (
        "scripts in names and records; numbers of 1e300, texts and nulls where residuals belong",
        "spikerig data sheet",
        "text on a page without scripts, links or handlers",
        SHEET + "test_names_and_records_of_others_do_no_harm",
    ),
    (
        "pictures of pure noise",
        "spikerig data sheet",
        "a page within its limit, pictures made smaller",
        SHEET + "test_a_page_fits",
    ),
    (
        "kill -9 between views, before the new file is on disk, before it takes the old one's place",
        "spikerig calib align",
        "the raw scene is as it was; the next run completes it and sweeps",
        PLACE + "test_kill_9_leaves_the_original",
    ),
    (
        "a full disk, an interrupt",
        "calib.posed_scene.write_poses",
        "the scene is as it was, nothing beside it",
        PLACE + "test_poses_are_written_in_place_or_not_at_all",
    ),
]
