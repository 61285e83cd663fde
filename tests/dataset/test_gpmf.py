"""GPMF by itself: items of all types, and types that lie."""

import struct

import pytest

from spikerig.dataset.errors import DataError
from spikerig.dataset.gpmf import header, items, streams, value
from spikerig.rigctl.sim.emulate.gpmf_write import item, nest

# ---- GPMF by itself -------------------------------------------------------------------------------------------------


def test_items_of_all_types_come_back():
    told = {i.key: value(i) for i in items(
        item("AAAA", "c", "hello") + item("BBBB", "L", [1, 2**32 - 1]) + item("CCCC", "s", -3)
        + item("DDDD", "f", [[1.5, 2.5], [3, 4]]) + item("EEEE", "J", 2**50) + item("FFFF", "F", "GPRO") + bytes(8)
    )}  # fmt: skip
    assert told == {
        "AAAA": "hello", "BBBB": [1, 2**32 - 1], "CCCC": -3, "DDDD": [[1.5, 2.5], [3.0, 4.0]], "EEEE": 2**50,
        "FFFF": "GPRO",
    }  # fmt: skip


def test_a_complex_sample_is_read_by_its_types():
    raw = struct.pack(">Lf", 7, 0.5) * 3
    inside = item("TYPE", "c", "Lf") + item("SCAL", "s", [[1], [2]])[:-4] + struct.pack(">hh", 1, 2)
    data = struct.pack(">4sBBH", b"ABCD", ord("?"), 8, 3) + raw
    (found,) = streams(nest("DEVC", item("DVID", "L", 1), nest("STRM", inside, data)))
    assert found.values.tolist() == [[7.0, 0.25]] * 3


@pytest.mark.parametrize("kinds", ["f[999999999]", "f[x]", "[3]", "f[" + "9" * 300])
def test_a_type_that_swells_is_refused(kinds):
    data = struct.pack(">4sBBH", b"ABCD", ord("?"), 4, 1) + bytes(4)
    with pytest.raises(DataError):
        streams(nest("DEVC", nest("STRM", item("TYPE", "c", kinds), data)))


def test_the_header_is_by_device():
    data = nest("DEVC", item("DVID", "L", 1), item("MINF", "c", "HERO9 Black")) + nest(
        "DEVC", item("DVID", "F", "FOVL")
    )
    assert header(data + bytes(100)) == {"1": {"DVID": 1, "MINF": "HERO9 Black"}, "FOVL": {"DVID": "FOVL"}}
