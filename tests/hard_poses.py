"""Hard inputs of camera poses from pictures."""

MODES = "calib/test_pose_modes.py::"
POSES = "calib/test_poses.py::"
PICTURES = "calib/test_pictures.py::"
ROWS = [
    (
        "no spike at all: black textures",
        "estimate_poses",
        "refused, none placed",
        MODES + "test_pictures_without_anything",
    ),
    ("one picture, six times", "estimate_poses", "refused", MODES + "test_identical_views"),
    ("a camera that turns at one place", "estimate_poses", "refused", MODES + "test_one_place"),
    ("two views", "estimate_poses", "UsageError: three are needed", MODES + "test_too_few_views"),
    (
        "half, 1.3 times and twice the right focal length",
        "estimate_poses",
        "refused, though residuals are small: a free focal length goes back to within 10 % of the right one",
        MODES + "test_another_cameras_intrinsics",
    ),
    (
        "no kind of texture places enough views",
        "estimate_poses",
        "every kind is tried once, then low contrast; refused",
        MODES + "test_a_second_try_keeps_its_own_name",
    ),
    (
        "features hardly found in any view",
        "spikerig calib poses",
        "exit 4, nothing written, what to try",
        POSES + "test_a_map_that_leaves_most_out_is_refused",
    ),
    (
        "kinds of texture that give different maps, residuals of 9 px, residuals that are NaN",
        "estimate_poses",
        "refused, each by its own reason",
        POSES + "test_reasons",
    ),
    (
        "a sensor without a fixed pattern, a dead pixel, fewer than eight views",
        "fixed_pattern",
        "none invented (sd under 0.2 %); within 25 %; None",
        "calib/test_pattern.py::test_none_is_invented",
    ),
    (
        "writing poses in place is interrupted, or the process is killed",
        "write_poses",
        "the scene is as it was, byte for byte",
        "calib/test_posed_scene.py::test_a_killed_write_leaves_the_scene_as_it_was",
    ),
    (
        "a board seen twice, from one direction, or moved between views",
        "scale_of",
        "no scale, and why",
        "calib/test_scale.py::test_why_there_is_none",
    ),
    (
        "COLMAP ends its process",
        "mapping.run_child",
        "one HostError that names the signal",
        PICTURES + "test_a_child_that_dies_is_one_clear_error",
    ),
    (
        "a folder without pictures, of equal stems, of unrelated pictures",
        "spikerig calib poses",
        "exit 2, 2, 4",
        "calib/test_pose_folder.py::test_folders_that_are_refused",
    ),
    (
        "two groups of views held together by few points",
        "weakest_link, judged",
        "refused below 35; below 60 unless all maps agree",
        POSES + "test_the_weakest_link_is_that_of_the_strongest_tree",
    ),
    (
        "a camera that turns by up to 150 degrees within an exposure",
        "smooth_path",
        "a curve of the spline's kind is met to 1e-8; covariances positive definite",
        "calib/test_smooth.py::test_a_known_curve_is_met_between_its_instants",
    ),
    (
        "a view of which no path could be measured",
        "still_paths",
        "it stands still, as unsure as the other views move",
        "calib/test_smooth.py::test_a_view_without_a_path_stands_still_and_unsure",
    ),
    (
        "a take whose views all have one pose",
        "write_poses",
        "the map's own world, in metres by the board; views not mapped are left out",
        "calib/test_posed_scene.py::test_a_take_without_poses_gets_the_maps_world",
    ),
]
