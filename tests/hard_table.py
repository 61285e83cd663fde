"""Hard cases of tables: kills, failures, foreign folders, costs that are never reached."""

TABLE, CLAIMS = "train/test_table.py::test_", "train/test_claims.py::test_"

ROWS = [
    (
        "kill -9 of the table, then of the fit it left",
        "train table --resume",
        "others kept out meanwhile; goes on from the checkpoint",
        TABLE + "kill_9_of_table_and_fit_and_resume",
    ),
    (
        "a fit killed by the system",
        "train table",
        "told in the table, tried again by --resume",
        TABLE + "a_fit_killed_by_the_system_is_told_and_tried_again",
    ),
    (
        "killed while scoring",
        "train table --resume",
        "scored again, not fitted again",
        TABLE + "finished_cells_stay_and_a_finished_fit_is_not_fitted_again",
    ),
    (
        "a cell that fails",
        "train table",
        "its message in the table, exit 1, the others there",
        TABLE + "a_table_end_to_end_with_a_cell_that_fails",
    ),
    (
        "cells of other settings in the folder",
        "train table --resume",
        "UsageError naming what differs",
        TABLE + "cells_of_other_settings_are_refused_or_made_anew_alone",
    ),
    (
        "a damaged cell, somebody else's folder, a file",
        "train table",
        "refused, nothing touched",
        TABLE + "damaged_cells_and_folders_of_others_are_refused",
    ),
    ("two tables in one folder", "train table", "UsageError", TABLE + "one_table_at_a_time_in_a_folder"),
    (
        "unknown methods, labels, settings, scopes; words that are the table's",
        "train table",
        "UsageError before any work, all at once",
        TABLE + "a_wrong_order_is_exit_2_before_any_work",
    ),
    (
        "missing scenes, one twice, no scene, another size",
        "train table",
        "UsageError or DataError",
        TABLE + "scenes_that_are_missing_twice_there_no_scenes_or_of_another_size",
    ),
    ("scenes of mixed sizes", "table_pictures.crops", "one sheet", TABLE + "scenes_of_mixed_sizes_stand_on_one_sheet"),
    (
        "a weights file with other bytes",
        "table.plan",
        "another cell",
        TABLE + "a_cell_is_known_by_all_that_its_numbers_depend_on",
    ),
    (
        "dB never reached, curves that fall, no curve",
        "table_numbers.reach",
        "all spent, as a lower bound",
        CLAIMS + "reach_is_linear_between_looks_and_censored_beyond",
    ),
    (
        "a censored cost",
        "claims",
        "not settled below the claimed share, else does not hold",
        CLAIMS + "a_cost_that_is_censored_never_holds_however_little_was_spent",
    ),
    (
        "a row that failed on one scene",
        "claims",
        "compared where both finished, and counted",
        CLAIMS + "a_scene_without_one_of_the_rows_is_left_out_of_the_difference_and_counted",
    ),
    (
        "rows absent or failed everywhere",
        "claims",
        "not in this table, and why",
        CLAIMS + "a_claim_whose_rows_are_absent_or_failed_says_so",
    ),
    ("a flat picture, one smaller than the crop", "liveliest", "a square inside it", CLAIMS + "the_liveliest_square"),
]
