"""The table of the rig's errors: what can go wrong on a wire, what is done about it, and the test that drives it there.

Each row is an error path that issue 5 names, in its order. `python tests/rig_errors.py > docs/hardware/errors.md`.
"""

from __future__ import annotations

from typing import NamedTuple


class Row(NamedTuple):
    """An error, what answers it, the wire it is driven over, and tests (`file::function`) that do."""

    error: str
    answer: str
    wire: str
    tests: tuple[str, ...]


USB, BLE, WIFI, SERIAL, DISK, NONE = "USB", "Bluetooth", "WiFi", "serial", "disk", "-"
_V, _W, _U = "rigctl/test_vidar.py::", "rigctl/test_recorder_wire.py::", "rigctl/test_ft60x.py::"
_R, _L, _C = "rigctl/test_recorder.py::", "rigctl/test_record.py::", "rigctl/test_rig_cli.py::"
_G, _H, _A, _P = (f"rigctl/test_gopro{k}.py::" for k in ("", "_web", "_wire", "_hand"))
_B, _F, _X = "rigctl/test_syncbox.py::", "rigctl/test_harpbox.py::", "rigctl/test_harp.py::"
_D, _S, _N = "rigctl/test_clockd.py::", "rigctl/test_clockd_wire.py::", "numerics/test_clock.py::"
_Z, _Q = "rigctl/test_record_slips.py::", "rigctl/test_pulse.py::"
_I, _M = "rigctl/test_ingest.py::", "rigctl/test_rawsource.py::"


def row(error: str, answer: str, wire: str, *tests: str) -> Row:
    """A row."""
    return Row(error, answer, wire, tests)


SPIKE = [
    row("timeout with data", "a short read; no loss, no new epoch", USB,
        _V + "test_a_timeout_with_data_is_a_short_read_and_no_loss"),
    row("timeout without data", "after 1 s the stream is begun anew, after 30 s it is given up (exit 3)", USB,
        _V + "test_silence_begins_the_stream_again_and_in_the_end_gives_up"),
    row("EPIPE (stall)", "`clear_halt`, once and only then; new epoch; still stalled: opened anew", USB,
        _V + "test_an_error_in_a_transfer_ends_the_epoch",
        _V + "test_a_stalled_endpoint_that_stays_so_is_reopened_not_hammered"),
    row("EOVERFLOW, EIO, EINTR", "the transfer's bytes count as lost; new epoch, gap record in the segment", USB,
        _V + "test_an_error_in_a_transfer_ends_the_epoch", _W + "test_an_error_on_the_bus_becomes_a_gap_record"),
    row("ENODEV (unplugged)", "looked for by serial, with growing pauses; new epoch, new gap record", USB,
        _V + "test_unplugged_and_back_under_the_same_serial", _V + "test_another_camera_is_not_taken_for_the_lost_one",
        _W + "test_an_error_on_the_bus_becomes_a_gap_record",
        _L + "test_an_unplugged_camera_comes_back_in_a_new_epoch"),
    row("back, but udev has not given permission yet", "waited for", USB,
        _V + "test_back_but_not_yet_permitted_is_waited_for"),
    row("stays away", "exit 3 in good order; what came is on disk; `--resume`", USB,
        _W + "test_a_camera_that_stays_away_costs_nothing_that_came",
        _L + "test_a_camera_that_stays_away_ends_the_take_in_good_order"),
    row("busy, no permission, no libusb, damaged strings, two alike, none", "refused, each with its cure", USB,
        _V + "test_busy_names_the_kernel_module", _V + "test_no_permission_prints_the_rule",
        _V + "test_no_libusb_names_both_cures", _V + "test_damaged_strings_and_settings_are_lived_with",
        _V + "test_two_alike_are_told_apart_by_where_they_are_plugged_in", _V + "test_nothing_plugged_in_is_told"),
    row("bytes missing that no error tells (bytes against time)",
        "new epoch `rate`, with the bytes it lies among as suspect", USB,
        _V + "test_a_silent_loss_is_seen_from_the_time_and_its_place_is_bounded", _V + "test_no_loss_is_unseen",
        _W + "test_a_loss_that_no_error_tells_is_in_the_gap_record_with_its_suspects"),
    row("bytes missing that neither an error nor the time tells", "seen by where ticks begin, while recording: new "
        "epoch `framing`, with its confidence; the viewpoint is taken again", USB,
        _Z + "test_a_loss_within_a_viewpoint_is_told_at_once_and_taken_again",
        _Z + "test_a_loss_after_a_viewpoints_spikes_begins_an_epoch_for_all_that_follow",
        _I + "test_a_loss_that_time_cannot_see_becomes_lost_ticks"),
    row("framing after a loss", "found again by correlation with the picture before, told with its confidence", USB,
        _W + "test_after_a_loss_the_framing_is_found_again_and_told",
        "rigctl/test_slip_watch.py::test_after_a_told_loss_the_framing_is_found_again_with_its_confidence"),
    row("a late host (no loss)", "not taken for a loss", USB,
        _V + "test_a_busy_host_sees_no_loss_where_there_is_none", _V + "test_memory_in_the_camera_bridges_a_late_host"),
    row("a mode that the link cannot carry", "plan refused with the numbers (exit 2), no device touched; on the wire: "
        "told as losing all the time", USB,
        _C + "test_a_plan_beyond_the_link_is_refused_before_any_device_is_touched",
        _U + "test_a_plan_beyond_the_link_is_refused_with_the_numbers",
        _U + "test_a_link_that_is_too_slow_loses_all_the_time_and_says_so"),
    row("a crystal off its nominal rate", "the rate is measured; it is no loss", USB,
        _V + "test_a_still_bus_gives_every_byte_in_one_epoch"),
    row("a row width or framing other than assumed", "`rig probe` tells which holds; exit 1 where none does", USB,
        _C + "test_probe_tells_the_row_width_of_an_emulated_camera",
        _C + "test_probe_convinces_nobody_on_noise_or_in_the_dark", _C + "test_a_camera_that_says_nothing_is_told"),
    row("a raw dump read too late; a vendor's library that drops or does not open",
        "as on the bus: new epoch; exit 6", "file, library",
        _M + "test_a_late_reader_loses_only_where_the_memory_is_finite",
        _M + "test_the_vendors_slot_sees_what_the_counter_hides",
        _M + "test_a_library_that_does_not_open_is_this_machines_fault"),
]  # fmt: skip

RGB = [
    row("HTTP while it encodes", "dark: refused or hanging, an error of its own within 3 s; state comes by Bluetooth",
        WIFI, _H + "test_http_is_dark_while_it_encodes"),
    row("wired control, shutter by HTTP", "not there (404, 500); never used", WIFI,
        _H + "test_what_a_hero9_does_not_do_over_http"),
    row("403: a setting refused in this state or order", "the reason and the options that would be taken; ours are "
        "sent in the order that is taken", WIFI,
        _H + "test_a_refused_setting_says_what_would_be_taken",
        _H + "test_the_order_of_settings_matters_and_ours_is_taken"),
    row("busy", "polled until idle, never faster than 50 ms", "WiFi, Bluetooth",
        _H + "test_a_busy_camera_refuses_with_error_1",
        _G + "test_it_is_never_asked_faster_than_it_likes_and_kept_awake"),
    row("HTTP back before it is idle", "waited for until it says idle", "WiFi, Bluetooth",
        _G + "test_stop_waits_until_it_is_idle_though_http_is_back_before"),
    row("falls asleep without a word for long", "keep-alive every 3 s; woken by Bluetooth", BLE,
        _G + "test_it_is_never_asked_faster_than_it_likes_and_kept_awake", _G + "test_sleep_and_wake"),
    row("start accepted and not done, or refused", "an error that says why", BLE,
        _G + "test_a_start_that_is_accepted_and_not_done_is_an_error", _G + "test_a_start_that_is_refused_says_why"),
    row("the answer to the shutter is lost", "decided by the state: one recording, not two", BLE,
        _G + "test_a_lost_answer_to_the_shutter_is_decided_by_the_state"),
    row("ends by itself (hot, full, battery)", "noticed, told, taken again; never kept", BLE,
        _G + "test_a_recording_that_ends_by_itself_is_noticed", _L + "test_a_recording_that_ends_early_is_not_kept",
        _L + "test_a_full_card_ends_the_take_and_what_was_kept_is_kept"),
    row("link breaks, packets lost, repeated, swapped, cut", "assembled or thrown away; asked again where that does no "
        "harm", BLE,
        _A + "test_damaged_packets_never_make_a_message",
        _A + "test_a_damaged_reply_is_thrown_away_and_asked_for_again",
        _G + "test_a_link_that_breaks_while_it_records_is_mended", _G + "test_damaged_answers_while_it_records"),
    row("no Bluetooth", "a person presses the button: the start is seen by HTTP going dark", WIFI,
        _P + "test_by_hand_the_start_is_seen_by_http_going_dark", _P + "test_by_hand_nobody_comes",
        _A + "test_a_camera_that_never_connects_is_an_error_that_names_the_fallback",
        "rigctl/test_gopro_bleak.py::test_without_bleak_the_extra_is_named"),
    row("a download breaks off, the server ignores ranges", "resumed after any byte, also by a later program", WIFI,
        _H + "test_a_download_that_breaks_off_goes_on", _H + "test_a_later_program_goes_on_where_an_earlier_stopped",
        _H + "test_over_a_real_socket"),
    row("chapters", "joined without a seam; others' refused", WIFI,
        _G + "test_several_takes_and_chapters", "dataset/test_gopro_file.py::test_chapters_are_joined_without_a_seam",
        "dataset/test_gopro_file.py::test_chapters_of_other_clips_are_refused"),
    row("turbo left on", "on while it downloads, off whatever came of it", WIFI,
        _H + "test_turbo_is_on_while_it_downloads_and_off_whatever_came_of_it"),
    row("undocumented Protune refused or without effect", "told; found in the MP4's own metadata", "Bluetooth, MP4",
        _G + "test_protune_that_is_refused_is_told",
        _G + "test_protune_that_is_taken_without_effect_is_found_in_the_file",
        _L + "test_a_fetched_clip_that_is_not_as_asked_is_told"),
    row("EIS on, lens not wide, another frame rate", "critical findings from the MP4", "Bluetooth, MP4",
        _G + "test_settings_that_fall_back_are_found_in_the_file"),
    row("frames lost in the camera, stamps or read-out missing, hostile files", "findings; one DataError", "MP4",
        _G + "test_frames_lost_in_the_camera_are_found",
        _G + "test_a_read_out_longer_than_a_frame_and_a_file_that_tells_nothing",
        "dataset/test_gopro_file.py::test_a_hostile_file_is_one_clear_error"),
]  # fmt: skip

BOX = [
    row("a damaged answer (checksum)", "one error; the next answer is well; no damaged time comes through", SERIAL,
        _B + "test_a_damaged_answer_is_one_error_and_the_next_is_well", _X + "test_one_damaged_bit_costs_one_message",
        _F + "test_a_bad_checksum_is_silence_on_one_and_no_matter_on_the_other"),
    row("answers doubled, or later than the next question", "one answer; never taken for the next", SERIAL,
        _B + "test_an_answer_that_comes_twice_is_one_answer", _B + "test_a_late_answer_is_not_taken_for_the_next"),
    row("the port is another program's", "exclusive: refused (exit 3)", SERIAL,
        _B + "test_a_port_is_one_programs", _B + "test_a_real_port_is_exclusive_and_says_when_it_is_taken"),
    row("unplugged, also in the middle of an answer", "an error; waited for; a new epoch of the driver", SERIAL,
        _B + "test_unplugged_and_back_is_a_new_epoch", _B + "test_pulled_while_waiting_for_an_answer",
        _L + "test_a_box_that_is_unplugged_is_told_and_comes_back"),
    row("another box, or none, answers", "refused", SERIAL,
        _B + "test_another_box_on_the_port_is_refused", _B + "test_nothing_answers"),
    row("two firmwares, and what each does with errors", "both understood", SERIAL,
        _F + "test_errors_of_the_atxmega_are_echoes", _F + "test_the_pico_is_silent_where_the_atxmega_complains",
        _S + "test_either_firmware_is_followed"),
    row("32-bit seconds roll over", "time goes on, no epoch", SERIAL,
        _B + "test_seconds_that_roll_over_go_on", _S + "test_seconds_that_roll_over_begin_no_epoch"),
    row("reset, step, set clock", "a new epoch", SERIAL,
        _B + "test_a_reset_is_a_new_epoch", _B + "test_a_step_of_its_clock_is_a_new_epoch", _B + "test_set_and_locked"),
    row("the 1 Hz sync packet: roll-over, cut", "the box's time to 1 ns; cut at the wrong byte: refused", "clock jack",
        _F + "test_the_sync_packet_of_each_second_tells_the_boxs_time"),
    row("no panel in view, panel misread", "nothing is guessed: refused; codes off by steps are left out",
        "both cameras", "rigctl/test_panel_take.py::test_a_take_without_a_panel_is_told",
        _N + "test_marks_that_went_wrong"),
]  # fmt: skip

CLOCK = [
    row("device reset", "an epoch; the host carries rig time over", SERIAL,
        _D + "test_a_box_that_boots_begins_an_epoch_and_keeps_its_skew"),
    row("host suspended", "told by the system's clocks; a break of `host`", SERIAL,
        _D + "test_a_suspend_is_told_and_the_box_found_again"),
    row("step", "within 200 us again after 4 s, in a new epoch; small untold ones found by the fit", SERIAL,
        _S + "test_a_step_that_nobody_tells_is_an_epoch_and_known_again_at_once",
        _N + "test_a_step_is_found_and_bridged"),
    row("wrap", "no epoch; within 100 us (Pico), 600 us (ATxmega)", SERIAL,
        _S + "test_seconds_that_roll_over_begin_no_epoch", _N + "test_counters_are_unwrapped"),
    row("duplicated, missing, damaged answers and pulses", "within 150 us; every pulse's number right or left out",
        SERIAL, _D + "test_damaged_lost_and_doubled_answers_do_no_harm",
        _S + "test_answers_lost_damaged_and_doubled_one_time_in_three", _N + "test_pulses_get_their_numbers"),
    row("a burst of outliers", "within 150 us during and after", SERIAL,
        _S + "test_a_burst_of_late_answers_does_not_pull_the_map"),
    row("a temperature ramp", "within 100 us at 5 ppm/min", SERIAL, _S + "test_a_warming_crystal_is_followed"),
    row("a minute without the box, at a take's default rate of questions", "within 100 us", SERIAL,
        _Q + "test_the_default_rate_carries_through_a_minute_within_100_us"),
    row("unplugged", "hold-over, with what it is good to; the same epoch if the box kept its time", SERIAL,
        _D + "test_unplugged_it_holds_over_and_goes_on_in_the_same_epoch", _D + "test_a_box_that_is_not_there_yet"),
]  # fmt: skip

RECORDER = [
    row("the disk falls behind", "told at half and three quarters of the ring; keeping ends before it runs over", DISK,
        _W + "test_keeping_ends_before_the_ring_runs_over"),
    row("loss on the link, loss in the recorder", "counted apart, each in the next chunk's header", "USB, disk",
        _W + "test_losses_of_the_recorder_are_counted_apart_from_the_links"),
    row("disk full", "told; what it took is whole, the rest counted", DISK,
        _W + "test_a_full_disk_keeps_what_it_took", _R + "test_a_full_disk_is_said_and_what_did_not_fit_is_counted"),
    row("no O_DIRECT", "told; through the page cache", DISK,
        _R + "test_a_file_system_without_o_direct_is_told_and_works"),
    row("kill -9", "every acknowledged chunk is there", "USB, disk",
        _R + "test_kill_9_costs_no_acknowledged_chunk", _W + "test_kill_9_while_the_bus_streams"),
    row("Ctrl-C, kill, going on", "`--resume` records the rest", "the whole rig",
        _L + "test_a_take_that_was_killed_or_interrupted_goes_on",
        _L + "test_prompts_retake_skip_quit_and_going_on"),
    row("a loss within a viewpoint", "told, and the viewpoint is taken again", "the whole rig",
        _L + "test_a_loss_on_the_link_is_told_and_the_viewpoint_taken_again"),
    row("torn or damaged chunks", "cost themselves only; their ticks are lost", DISK,
        "dataset/test_segments.py::test_a_torn_last_chunk_costs_only_itself",
        _I + "test_a_damaged_chunk_becomes_lost_ticks"),
]  # fmt: skip

PARTS = {
    "Spike camera": SPIKE, "GoPro": RGB, "Clock box and panel": BOX, "Clock service": CLOCK, "Recorder": RECORDER,
}  # fmt: skip


def page() -> str:
    """docs/hardware/errors.md."""
    lines = [
        "# What can go wrong on a wire, and the test that makes it go wrong there",
        "",
        "Each error is driven through the emulated wire below the driver (`rigctl/sim/emulate`), not into a function. "
        "Made by `python tests/rig_errors.py > docs/hardware/errors.md`; a test holds page and names to the code.",
    ]
    for part, rows in PARTS.items():
        lines += ["", f"## {part}", "", "| error | what is done | over | tests |", "|---|---|---|---|"]
        lines += [f"| {r.error} | {r.answer} | {r.wire} | {', '.join(f'`{t}`' for t in r.tests)} |" for r in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(page(), end="")
