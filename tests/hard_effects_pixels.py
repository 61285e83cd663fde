"""Hard inputs of the effects on photons, charge, spikes, wire and clock."""

T = "rigctl/test_effects_"
ROWS = [
    (
        "no light, few ticks, everything on",
        "simulate",
        "no spike and no charge; saturated: a spike every tick",
        T + "charge.py::test_no_light_and_few_ticks",
    ),
    (
        "shot noise on odd sizes and one tick",
        "shot_noise",
        "shapes as asked, padding zero, charge not negative",
        T + "photons.py::test_odd_sizes_and_one_tick",
    ),
    (
        "HDR 1e7:1 with a saturated corner",
        "shot_noise",
        "light within 5 sigma, at most a spike a tick, the rest counted",
        T + "photons.py::test_saturated_and_hdr",
    ),
    (
        "a highlight of 3 thresholds a tick, then dark",
        "saturation",
        "clipped: 4 spikes, 8 lost; carried: 12 spikes, none lost",
        T + "charge.py::test_a_highlight_that_is_carried_fires_on",
    ),
    (
        "every effect inside a pixel at once, light up to 1.5",
        "fire_noisy",
        "in = fired + left + lost",
        T + "charge.py::test_all_inside_the_pixel_conserve_charge",
    ),
    (
        "HDR 1e6:1 with comparator and resets",
        "simulate",
        "counts within one spike and the resets' share",
        T + "charge.py::test_hdr",
    ),
    (
        "hostile map files: not an archive, cut, objects, NaN, wrong sizes",
        "read_maps",
        "one DataError that names them all; nothing unpickled",
        T + "charge.py::test_maps_that_cannot_be_used",
    ),
    (
        "maps smaller than the picture",
        "sensor_map",
        "DataError",
        T + "charge.py::test_a_map_smaller_than_the_picture",
    ),
    ("all pixels stuck", "stuck_pixels", "all zero, or all one", T + "spikes.py::test_all_dead_and_all_lit"),
    (
        "a row never read",
        "row_noise",
        "zero from the start",
        T + "spikes.py::test_a_row_that_drops_reads_zero",
    ),
    ("everything lost", "lost_blocks", "one lost range, all zero", T + "wire.py::test_everything_lost"),
    (
        "every bit flipped; widths that are no multiple of 8",
        "bit_flips",
        "all pixels, never the padding",
        T + "wire.py::test_flips_have_their_chance_and_spare_the_padding",
    ),
    (
        "rows of 416, 20 and 5 bits on the wire",
        "wire_bytes",
        "decode to the same spikes whatever the trailer",
        T + "wire.py::test_bytes_on_the_wire_decode_to_the_same_spikes",
    ),
    (
        "a clock that steps back into the view before",
        "true_clock",
        "UsageError before anything is written",
        T + "clock.py::test_a_clock_that_steps_back_into_the_view_before",
    ),
    ("a random walk past its span, at 0", "walk", "stands still; 0", T + "clock.py::test_a_random_walk_is_one_path"),
    (
        "effects and maps that contradict each other",
        "read_scene",
        "UsageError that names both",
        "rigctl/test_presets.py::test_maps_and_presets_that_do_not_go_together",
    ),
    (
        "streams too short or too dark for statistics",
        "statistics",
        "DataError",
        "rigctl/test_presets.py::test_streams_without_statistics",
    ),
]
