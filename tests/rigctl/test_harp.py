"""Harp's bytes: published vectors, real dumps, and streams with errors in them."""

import random

import pytest

from spikerig.dataset.errors import DataError, UsageError
from spikerig.rigctl import harp
from spikerig.rigctl.harp import Decoder, Message, encode

VECTORS = {
    "01 04 00 FF 02 06": harp.read(harp.WHO_AM_I, harp.U16),
    "01 0C 00 FF 12 E8 03 00 00 09 3D C0 04 13": Message(1, 0, harp.U16, b"\xc0\x04", (1000, 15625)),
    "02 05 0A FF 01 65 76": harp.write(harp.OPERATION, harp.U8, 0x65),
    "02 08 08 FF 04 00 F1 53 65 BE": harp.write(harp.SECOND, harp.U32, 1_700_000_000),
    "03 0C 12 FF 12 E9 03 00 00 00 00 03 00 21": Message(3, 18, harp.U16, b"\x03\x00", (1001, 0)),
    "09 0A C8 FF 11 E9 03 00 00 00 00 D7": Message(9, 200, harp.U8, b"", (1001, 0)),
}


@pytest.mark.parametrize("text", VECTORS)
def test_vectors_both_ways(text):
    data = bytes.fromhex(text)
    assert encode(VECTORS[text]) == data
    assert Decoder().feed(data) == [VECTORS[text]]


def test_values_and_stamps():
    (told,) = Decoder().feed(bytes.fromhex("01 0C 00 FF 12 E8 03 00 00 09 3D C0 04 13"))
    assert told.values().tolist() == [1216]
    assert told.stamp_ns == 1000_500_000_000
    assert not told.refused
    assert VECTORS["09 0A C8 FF 11 E9 03 00 00 00 00 D7"].refused
    with pytest.raises(DataError):
        _ = harp.read(0).stamp_ns


@pytest.mark.real
@pytest.mark.parametrize(("name", "count"), [("device_0", 1), ("device_44", 1), ("write_0", 4), ("empty_0", 0)])
def test_real_dumps(shared_data, name, count):
    data = shared_data(f"harp/data/{name}.bin").read_bytes()
    decoder = Decoder()
    told = decoder.feed(data)
    assert len(told) == count
    assert decoder.skipped == 0
    assert not decoder.waiting
    assert b"".join(encode(m) for m in told) == data
    if name == "device_44":
        assert told[0].values().tolist() == [1, 0, 2]
        assert told[0].stamp == (10872, 23156)


def test_any_cut_gives_the_same_messages():
    data = b"".join(bytes.fromhex(text) for text in VECTORS)
    for cut in range(len(data)):
        decoder = Decoder()
        assert decoder.feed(data[:cut]) + decoder.feed(data[cut:]) == list(VECTORS.values())


def test_one_damaged_bit_costs_one_message():
    whole = list(VECTORS.values()) * 3
    frames = [encode(m) for m in whole]
    rng = random.Random(0)
    for _ in range(300):
        hit = rng.randrange(len(frames))
        bad = bytearray(frames[hit])
        bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
        decoder = Decoder()
        told = decoder.feed(b"".join([*frames[:hit], bytes(bad), *frames[hit + 1 :]]))
        while decoder.waiting:
            told += decoder.give_up()
        assert told[:hit] == whole[:hit]
        # What comes behind is found again; at worst a frame is taken for the damaged one's tail.
        assert len(told) >= len(whole) - 2
        assert told[-(len(whole) - hit - 2) :] == whole[hit + 2 :] or hit >= len(whole) - 2


def test_noise_is_no_message():
    noise = random.Random(1).randbytes(20_000)
    decoder = Decoder()
    told = decoder.feed(noise)
    while decoder.waiting:
        told += decoder.give_up()
    # a checksum is one byte: a frame that looks right by chance is 1 in 256 of the plausible heads
    assert len(told) < 40
    assert decoder.skipped + sum(len(encode(m)) for m in told) == len(noise)


def test_payloads_that_cannot_be_are_refused():
    with pytest.raises(UsageError):
        encode(Message(2, 8, harp.U32, b"\0\0\0"))
    with pytest.raises(UsageError):
        encode(Message(2, 8, harp.U8, bytes(251)))
    with pytest.raises(DataError):
        Message(1, 8, 0x03, b"").values()


def test_seconds_roll_over():
    top = (harp.ROLL_S - 1) * harp.NS
    assert harp.unwrapped_ns(5, top + 10) == harp.ROLL_S * harp.NS + 5
    assert harp.unwrapped_ns(top, top + 10) == top
    assert harp.unwrapped_ns(7, 0) == 7


def test_sync_packets():
    assert harp.sync_packet(999) == bytes.fromhex("AA AF E7 03 00 00")
    assert harp.parse_sync(bytes.fromhex("AA AF E7 03 00 00")) == (1000, 1000 * harp.NS - 572_000)
    assert harp.parse_sync(harp.sync_packet(harp.ROLL_S - 1)).second == 0
    with pytest.raises(DataError):
        harp.parse_sync(b"\xaa\xaf\0\0\0")
