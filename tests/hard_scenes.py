"""Hard inputs of the synthetic scenes: small parts, cut-outs, gloss; and of the dataset they make."""

NUMERICS = "numerics/test_scenes.py::"
PARTS = "rigctl/test_parts.py::"
GLOSS = "rigctl/test_gloss.py::"
DATASET = "rigctl/test_dataset.py::"
ROWS = [
    (
        "a panel seen edge-on, rays within a face",
        "Stage.picture",
        "finite; a line at most",
        NUMERICS + "test_a_panel_seen_edge_on",
    ),
    (
        "a rod seen along its axis",
        "Stage.depth",
        "the cap's depth, nothing beside it",
        NUMERICS + "test_a_rod_seen_along_its_axis",
    ),
    (
        "a ball of 1e-3 at 100 units",
        "Stage.depth",
        "its outline to 2 %, its depth to 2e-5",
        NUMERICS + "test_tiny_and_far",
    ),
    (
        "parts behind, beside and across the camera's plane; the camera within a crowd's bounding ball",
        "Crowd.hit",
        "the same hits as without bounds",
        NUMERICS + "test_parts_around_the_camera",
    ),
    ("20,000 parts", "Stage.picture", "finite light, bounded memory", NUMERICS + "test_twenty_thousand_parts"),
    (
        "no bricks; a lamp inside a part or on it; parts that shine",
        "Stage",
        "finite light",
        NUMERICS + "test_nothing_to_build",
    ),
    (
        "gloss at grazing angles",
        "glossy",
        "finite; at most the light that comes",
        NUMERICS + "test_gloss_at_grazing_angles",
    ),
    (
        "a highlight of any roughness and angle",
        "highlight",
        "gives back no more than comes",
        GLOSS + "test_a_highlight_gives_back_no_more_than_comes",
    ),
    (
        "the same light from everywhere",
        "glossy",
        "no surface brighter than it",
        GLOSS + "test_a_bright_room_stays_as_bright",
    ),
    ("the lamp among the parts", "Crowd.shadowed", "as part by part", GLOSS + "test_shadows_by_cells_and_one_by_one"),
    (
        "where the coordinates of round things begin and end",
        "CrowdMap.at",
        "no seam",
        GLOSS + "test_round_things_have_no_seam",
    ),
    (
        "parts of no size, a cylinder of no length, a leaf cut of a ball",
        "read_world",
        "every fault by its key",
        PARTS + "test_faults_of_solids",
    ),
    (
        "a camera inside a part",
        "load_scene_toml",
        "UsageError that names view and solid",
        PARTS + "test_cameras_stand_outside",
    ),
    ("kill -9 between views", "sim dataset", "goes on; the same bytes", DATASET + "test_a_killed_run_goes_on"),
    ("kill -9 with worker processes", "sim dataset", "they end too", DATASET + "test_workers_end_with_a_killed_run"),
    (
        "a finished view or a sealed scene that is damaged",
        "sim dataset",
        "made again; the same bytes",
        DATASET + "test_a_damaged_view_and_a_damaged_scene_are_made_again",
    ),
    (
        "pickles and foreign records for a finished view",
        "shelf.loads",
        "DataError",
        "rigctl/test_shelf.py::test_foreign_views_are_refused",
    ),
    (
        "workers with another CPU, NumPy or spikerig",
        "Cluster",
        "left out with a note; refused",
        DATASET + "test_workers_of_one_kind_are_used",
    ),
    (
        "a scheduler that does not answer",
        "sim dataset --scheduler",
        "HostError within seconds",
        DATASET + "test_nobody_answers",
    ),
]
