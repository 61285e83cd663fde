"""Hard cases of GoPro clips and of the GoPro's wire."""

_FILE, _WIRE, _CAMERA = "dataset/test_gopro_file.py", "rigctl/test_gopro_wire.py", "rigctl/test_gopro.py"
_WEB = "rigctl/test_gopro_web.py"

ROWS = [
    ("sizes, counts and offsets of 0, 2^31, 2^63, 2^64 - 1; boxes 10,000 deep; moov missing, twice, cut off",
     "open_gopro", "one DataError with the file and the cause",
     f"{_FILE}::test_a_hostile_file_is_one_clear_error"),
    ("bytes flipped at random in tables and telemetry", "open_gopro", "a RigError or increasing frame times",
     f"{_FILE}::test_flipped_bytes_never_bring_a_traceback"),
    ("bytes flipped at random in the pictures", "read_pictures", "a DataError or a picture",
     f"{_FILE}::test_flipped_bytes_in_the_pictures_are_a_data_error_or_a_picture"),
    ("NaN, negative, text where exposures and read-out times should be", "open_gopro", "a DataError",
     f"{_FILE}::test_a_hostile_file_is_one_clear_error"),
    ("sensor frames lost between two stamps", "frame_times", "a gap of whole frames where they were lost, within 1 us",
     f"{_FILE}::test_an_emulated_clips_times_are_the_true_ones_on_its_clock"),
    ("chapters whose stamps run on, and that begin anew", "open_gopro", "no seam; a remark where it was guessed",
     f"{_FILE}::test_chapters_whose_stamps_begin_anew_follow_each_other"),
    ("offsets beyond 4 GB", "read_movie", "the bytes at that place", f"{_FILE}::test_long_offsets_are_read"),
    ("type strings that swell to 10^9 columns", "gpmf.streams", "a DataError, nothing allocated",
     "dataset/test_gpmf.py::test_a_type_that_swells_is_refused"),
    ("packets lost, repeated, swapped, cut, too long, empty", "Assembler", "no message, and the next one is heard",
     f"{_WIRE}::test_damaged_packets_never_make_a_message"),
    ("random packets", "Assembler", "no exception", f"{_WIRE}::test_random_packets_never_raise"),
    ("JSON that is none, or 100,000 deep", "Web", "a DeviceError", f"{_WEB}::test_answers_that_are_none"),
    ("downloads that break after any byte, servers that ignore ranges", "Web.download", "the whole file, bit for bit",
     f"{_WEB}::test_a_download_that_breaks_off_goes_on"),
    ("the answer to the shutter is lost", "GoProSource", "one recording, not two",
     f"{_CAMERA}::test_a_lost_answer_to_the_shutter_is_decided_by_the_state"),
    ("settings taken without effect", "verify_clip", "each found in the clip",
     f"{_CAMERA}::test_protune_that_is_taken_without_effect_is_found_in_the_file"),
]  # fmt: skip
