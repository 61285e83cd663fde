"""Hard inputs of events: the record, the file, the kernel, the simulated camera."""

NUMERICS = "numerics/test_events.py::"
FILE = "dataset/test_events.py::"
SIM = "rigctl/test_events.py::"
ROWS = [
    ("no light at all", "kernels.events", "no event: eps stands for the dark", NUMERICS + "test_no_light"),
    ("constant light", "kernels.events", "no event", NUMERICS + "test_constant_light"),
    (
        "light from nothing to white, and back",
        "kernels.events",
        "log(1 + 1/eps) / threshold events up, as many down, at the times of the closed form",
        NUMERICS + "test_from_nothing_to_white_and_back",
    ),
    (
        "a jump of 1e6 to 1 at one pixel",
        "kernels.events",
        "all its events at one time; with a refractory time a single one",
        NUMERICS + "test_a_jump_of_a_million",
    ),
    (
        "more events than allowed: small thresholds, large contrast",
        "kernels.events",
        "one NumericsError, soon, before memory is asked for",
        NUMERICS + "test_too_many_events_are_refused_soon",
    ),
    (
        "refractory time longer than the exposure",
        "kernels.events",
        "one event a pixel",
        NUMERICS + "test_refractory_longer_than_the_exposure",
    ),
    (
        "unequal thresholds",
        "kernels.events",
        "as the oracle: polarities by their own",
        NUMERICS + "test_unequal_thresholds",
    ),
    (
        "one knot, or one picture that holds",
        "kernels.events, simulate_events",
        "no event in an empty or a still span",
        NUMERICS + "test_one_knot",
    ),
    ("odd sizes, one pixel, over a block of pixels", "kernels.events", "as the oracle", NUMERICS + "test_sizes"),
    (
        "light that turns just at, before and beyond a threshold",
        "kernels.events",
        "an event if the level is reached, none a hair below it, the reference is the level",
        NUMERICS + "test_turning_at_a_threshold",
    ),
    (
        "light exactly on a threshold at a knot",
        "kernels.events",
        "one event at the knot, not two",
        NUMERICS + "test_a_threshold_at_a_knot",
    ),
    (
        "a threshold reached just at the end of the span",
        "kernels.events",
        "left out: spans are half-open",
        NUMERICS + "test_a_threshold_at_the_end",
    ),
    (
        "float32 light of 1e-38 and 3e38",
        "kernels.events",
        "finite times in order",
        NUMERICS + "test_the_ends_of_float32",
    ),
    (
        "a photoreceptor far faster or slower than the light",
        "kernels.events",
        "the light itself; no event",
        NUMERICS + "test_the_limits_of_the_photoreceptor",
    ),
    (
        "light that is negative, NaN or infinite",
        "kernels.events, simulate_events",
        "NumericsError",
        NUMERICS + "test_light_that_is_none",
    ),
    (
        "noise in a pixel that is held; noise at one time twice",
        "kernels.events",
        "lost; both events",
        NUMERICS + "test_noise_resets_and_is_lost_in_reset",
    ),
    (
        "any thread count, any instruction set",
        "kernels.events",
        "the same bits",
        NUMERICS + "test_the_same_bits_everywhere",
    ),
    ("faults of 0", "simulate_events", "the ideal camera, bit for bit", SIM + "test_faults_vanish_at_zero"),
    (
        "columns and rows of 65535; numbers that would wrap",
        "EventStream",
        "kept; DataError",
        FILE + "test_numbers_that_a_type_cannot_hold_are_refused_not_wrapped",
    ),
    (
        "events out of order, outside the span or the picture, of other polarities",
        "EventStream",
        "DataError",
        FILE + "test_what_is_no_event_is_refused",
    ),
    (
        "hostile events in a scene file: bombs, links, garbled chunks, unequal columns",
        "open_scene, verify_scene",
        "one DataError; a finding even where the checksums fit",
        FILE + "test_hostile_events_end_in_one_error_and_a_finding",
    ),
    (
        "9 million equal events (72 MB in 0.1 MB)",
        "SceneWriter",
        "stored plain, for a reader must take the packed ones for a bomb",
        FILE + "test_events_that_pack_too_well_are_stored_plain",
    ),
]
