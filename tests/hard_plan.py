"""Hard inputs of the plan of effects."""

AUTO = {"effects": "auto", "consider": ["shot_noise", "dark_current", "threshold_fpn", "read_noise"]}
PLAN = "rigctl/test_plan.py::"
HARD = PLAN + "test_hard_scenes_have_a_plan"
SAMPLES, FILES = "rigctl/test_plan_samples.py::", "rigctl/test_plan_files.py::"
ROWS = [
    ("no light, saturated, one pixel, one view", "plan", "finite bounds; what cannot matter is left out", HARD),
    ("tolerance 0", "plan", "everything with a bound above 0 stays", PLAN + "test_no_tolerance_and_a_huge_one"),
    ("a tolerance of 1e9", "plan", "nothing stays", PLAN + "test_no_tolerance_and_a_huge_one"),
    (
        "bounds that fit in one output and not in the other",
        "plan",
        "each sum stays within its own tolerance",
        PLAN + "test_smallest_first_while_the_sum_fits_in_both_outputs",
    ),
    (
        "pictures of one value, every pixel starting empty",
        "plan",
        "only whole steps of the tolerance are used",
        PLAN + "test_few_values_leave_only_whole_steps",
    ),
    (
        "effects that matter only through others",
        "bounds_of",
        "a late clock under a lamp that flickers, patterns on dark current, values through a file",
        PLAN + "test_effects_are_judged_on_what_reaches_them",
    ),
    (
        "50 px of motion an exposure, and 1e6 px",
        "sampled",
        "0.25 px a step; never more samples than ticks",
        SAMPLES + "test_samples_of_fast_motion",
    ),
    ("no motion", "sampled", "one sample that stands still", SAMPLES + "test_light_samples_follow_the_motion"),
    (
        "points behind the camera, or infinitely far",
        "motion_px",
        "finite; far ones only turn",
        SAMPLES + "test_motion_of_known_moves",
    ),
    (
        "unknown and duplicate effects in `consider`, tolerances out of range",
        "load_scene_toml",
        "all faults at once, the nearest name",
        FILES + "test_faults_of_auto_are_told",
    ),
    (
        "a scene that needs nothing",
        "take_view",
        "no module of an effect is imported",
        PLAN + "test_nothing_is_imported_where_nothing_is_needed",
    ),
    (
        "quotes, escapes, infinities, nested lists of tables",
        "toml_text",
        "read back as they were",
        FILES + "test_toml_text_reads_back",
    ),
]
