"""Hard inputs of recording: torn files, slow disks, kills, lies."""

SEG, RAW = "dataset/test_segments.py::", "dataset/test_rawtake.py::"
REC, LOOP, CUT = "rigctl/test_recorder.py::", "rigctl/test_record.py::", "rigctl/test_ingest.py::"
ROWS = [
    ("torn at any byte", "scan", "costs the last chunk only", SEG + "test_a_torn_last_chunk_costs_only_itself"),
    (
        "a head or payload destroyed in the middle",
        "scan",
        "the rest is read, the hole is named",
        SEG + "test_a_hole_in_the_middle_is_stepped_over",
    ),
    (
        "chunks of another take, old chunks behind new ones",
        "scan",
        "not believed",
        SEG + "test_chunks_of_another_take_and_old_ones_are_not_believed",
    ),
    ("magic words in a payload", "scan", "a payload", SEG + "test_a_payload_full_of_magic_words_is_only_a_payload"),
    ("40 holes of noise in a segment", "scan", "damage, never a fault", SEG + "test_noise_is_damage_and_never_a_fault"),
    (
        "a sealed head with sizes that contradict each other",
        "decode_head",
        "no head",
        SEG + "test_a_sealed_head_that_contradicts_itself_is_none",
    ),
    ("views.jsonl with paths, spans backwards, deep JSON", "views", "refused by line",
     RAW + "test_views_that_lie_are_refused_by_line"),
    ("take.json with huge or negative sizes", "open_take", "refused", RAW + "test_descriptions_that_lie_are_refused"),
    ("kill -9 at 20 random moments", "Recorder", "every acknowledged chunk is there",
     REC + "test_kill_9_costs_no_acknowledged_chunk"),
    ("a disk that stands still", "Recorder", "keeping ends before anything is lost",
     REC + "test_a_slow_disk_ends_recording_before_anything_is_lost"),
    ("a full ring with on_full = drop", "Recorder", "every lost byte counted", REC + "test_dropping_counts_every_byte"),
    ("a full disk", "Recorder", "said; what did not fit is counted",
     REC + "test_a_full_disk_is_said_and_what_did_not_fit_is_counted"),
    ("a camera that dies", "Recorder", "what came is on disk", REC + "test_a_camera_that_dies_costs_nothing_that_came"),
    ("kill and Ctrl-C in the middle of a take", "record", "the rest is recorded by --resume",
     LOOP + "test_a_take_that_was_killed_or_interrupted_goes_on"),
    ("a damaged chunk under a frame", "ingest", "lost ticks, all other bits the same",
     CUT + "test_a_damaged_chunk_becomes_lost_ticks"),
    ("black panel at both edges of the picture", "Framing", "the panel tells where ticks begin",
     CUT + "test_the_panel_ties_frames_and_spikes_without_any_truth"),
]  # fmt: skip
