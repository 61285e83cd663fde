"""Hard inputs of aligned scenes and of the boards before a scene's rig: the rows that say what must come out."""

TIMES, STRAIGHT, BOARDS = (
    "dataset/test_view_times.py::test_",
    "train/test_straight.py::test_",
    "rigctl/test_sim_boards.py::test_",
)

ROWS = [
    ("a crop of a rolling frame", "View.instant_ns", "the time of its own middle row, not of the picture's",
     TIMES + "a_crop_is_read_when_its_own_rows_were"),
    ("a middle row without a valid pixel, nothing valid", "View.middle_row", "the median of the others, the middle",
     TIMES + "rows_of_pixels_that_are_not_seen_do_not_count"),
    ("a rolling shutter, the arms turned", "write_aligned", "each pixel's time within a row",
     "calib/test_align_rolling.py::test_rows_keep_the_time_of_the_raw_row_they_came_from"),
    ("a mirrored spike arm", "load_targets", "the same bits as of an arm that is not",
     STRAIGHT + "a_mirrored_arm_trains_on_the_very_same_textures"),
    ("single spikes behind a lens that bends", "load_targets", "UsageError",
     STRAIGHT + "single_spikes_of_a_lens_that_bends_are_refused"),
    ("a calibration record of another sensor", "straight_of", "DataError",
     STRAIGHT + "a_scene_that_was_not_aligned_is_left_alone_and_a_foreign_record_is_refused"),
    ("tangential lenses behind a mirror, either arm", "true_calibration", "agrees with the scene's own optics",
     BOARDS + "lenses_cast_through_show_what_the_scenes_optics_redraw"),
    ("both arms mirrored, a mirror top to bottom", "true_calibration", "UsageError",
     BOARDS + "a_rig_that_no_calibration_describes_is_refused"),
]  # fmt: skip
