"""Raw segments: what is whole is read, what is not is named, nothing is believed unchecked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xxhash

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.segments import (
    MAGIC,
    MAX_STAMPS,
    PAGE,
    SEALED,
    STAMP,
    Chunk,
    ChunkHead,
    Damage,
    chunk_ticks,
    decode_head,
    encode_head,
    padded,
    scan,
    thinned,
)

NO_STAMPS = np.zeros(0, STAMP)


def chunk(number: int, size: int = 10_000, **more: int) -> tuple[ChunkHead, bytes]:
    data = np.random.default_rng(number).integers(0, 256, size, np.uint8).tobytes()
    base = ChunkHead(7, number, 0, number * size, 500, 10 * number, 10 * number + 9)
    head = replace(base, **more, payload=size, digest=xxhash.xxh3_64_intdigest(data))
    return head, encode_head(head, stamps(3, size)) + data.ljust(padded(size), b"\0")


def stamps(n: int, size: int) -> np.ndarray:
    table = np.zeros(n, STAMP)
    table["end"] = np.linspace(size / n, size, n).astype(int)
    table["before_ns"], table["after_ns"] = 5, 6
    return table


def segment(path: Path, count: int = 5, tail: int = 0) -> list[tuple[ChunkHead, bytes]]:
    made = [chunk(k) for k in range(count)]
    path.write_bytes(b"".join(data for _, data in made) + bytes(tail))
    return made


def whole(path: Path, **more: int) -> list[ChunkHead]:
    return [found.head for found in scan(path, **more) if isinstance(found, Chunk)]


def damage(path: Path, **more: int) -> list[Damage]:
    return [found for found in scan(path, **more) if isinstance(found, Damage)]


def test_a_segment_reads_back_with_stamps_and_bytes(tmp_path: Path) -> None:
    made = segment(tmp_path / "0000.seg")
    found = list(scan(tmp_path / "0000.seg", take=7))
    for (head, data), one in zip(made, found, strict=True):
        assert isinstance(one, Chunk)
        assert one.head == head
        assert np.array_equal(one.stamps, stamps(3, 10_000))
        assert one.read().tobytes() == data[PAGE : PAGE + 10_000]


def test_a_head_tells_everything_it_was_given() -> None:
    head = ChunkHead(2**64 - 1, 3, 4, 5_000_001, 500, -6, 2**62, 7, 8, 9, "overflow", 11, 10, 2**64 - 1)
    data = encode_head(head, NO_STAMPS)
    decoded = decode_head(data)
    assert len(data) == PAGE
    assert decoded is not None
    assert decoded[0] == head
    assert head.tick == 10_001  # the first that begins in it
    with pytest.raises(UsageError, match="do not fit"):
        encode_head(replace(head, number=-1), NO_STAMPS)


@pytest.mark.parametrize("at", [8, 20, 60, 130, 200, 256, 300, 4000, SEALED, PAGE - 1])
def test_a_flipped_bit_anywhere_in_a_head_unmakes_it(at: int) -> None:
    _, data = chunk(1)
    head = bytearray(data[:PAGE])
    assert decode_head(bytes(head)) is not None
    head[at] ^= 4
    assert decode_head(bytes(head)) is None


def seal(body: bytes) -> bytes:
    return body[:SEALED] + xxhash.xxh3_64_intdigest(body[:SEALED]).to_bytes(8, "little")


@pytest.mark.parametrize(
    ("offset", "value"),
    [(12, 0), (96, 0), (96, 1 << 31), (100, 4096), (48, 1), (10, 60_000)],
    ids=["no tick", "no payload", "a huge payload", "wrong padding", "wrong tick", "too many stamps"],
)
def test_a_sealed_head_that_contradicts_itself_is_none(offset: int, value: int) -> None:
    _, data = chunk(1)
    size = 2 if offset == 10 else 4
    body = data[:offset] + value.to_bytes(size, "little") + data[offset + size : PAGE]
    assert decode_head(seal(data[:PAGE])) is not None
    assert decode_head(seal(body)) is None


def test_a_newer_version_is_refused_by_name(tmp_path: Path) -> None:
    _, data = chunk(0)
    (tmp_path / "0000.seg").write_bytes(seal(data[:8] + (2).to_bytes(2, "little") + data[10:PAGE]) + data[PAGE:])
    with pytest.raises(DataError, match="newer version"):
        list(scan(tmp_path / "0000.seg"))


def test_room_set_aside_is_no_damage(tmp_path: Path) -> None:
    made = segment(tmp_path / "0000.seg", tail=9 << 20)
    assert whole(tmp_path / "0000.seg") == [head for head, _ in made]
    assert damage(tmp_path / "0000.seg") == []


@pytest.mark.parametrize("keep", [0, 1, PAGE - 1, PAGE, PAGE + 1, 10_000, PAGE + 10_000 - 1])
def test_a_torn_last_chunk_costs_only_itself(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "0000.seg"
    made = segment(path)
    path.write_bytes(path.read_bytes()[: 4 * len(made[0][1]) + keep])
    assert whole(path) == [head for head, _ in made[:4]]
    assert bool(damage(path)) == (keep > 0)
    assert all(one.offset == 4 * len(made[0][1]) for one in damage(path))


def test_a_payload_that_was_not_padded_to_the_end_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "0000.seg"
    made = segment(path)
    path.write_bytes(path.read_bytes()[: 4 * len(made[0][1]) + PAGE + 10_000])
    assert len(whole(path)) == 5


def test_a_hole_in_the_middle_is_stepped_over(tmp_path: Path) -> None:
    path = tmp_path / "0000.seg"
    made = segment(path)
    size = len(made[0][1])
    data = bytearray(path.read_bytes())
    data[size : size + PAGE] = np.random.default_rng(0).bytes(PAGE)  # a head
    data[3 * size + PAGE + 17] ^= 1  # a payload
    path.write_bytes(data)
    assert [head.number for head in whole(path)] == [0, 2, 4]
    first, second = damage(path)
    assert (first.offset, first.length) == (size, size)
    assert (second.offset, second.length) == (3 * size, size)
    assert "checksum" in second.why
    heads = [found for found in scan(path, verify=False) if isinstance(found, Chunk)]
    assert [c.head.number for c in heads] == [0, 2, 3, 4]
    with pytest.raises(DataError, match="damaged"):
        heads[2].read()


def test_chunks_of_another_take_and_old_ones_are_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "0000.seg"
    parts = [chunk(3)[1], chunk(4, take=8)[1], chunk(2)[1], chunk(5)[1]]
    path.write_bytes(b"".join(parts))
    assert [head.number for head in whole(path, take=7)] == [3, 5]
    assert [one.why for one in damage(path, take=7)] == ["a chunk of another take", "chunk 2 after chunk 3"]


def test_a_payload_full_of_magic_words_is_only_a_payload(tmp_path: Path) -> None:
    path = tmp_path / "0000.seg"
    data = MAGIC * (5 * PAGE // 8)
    head = ChunkHead(7, 0, 0, 0, 500, 0, 0, payload=len(data), digest=xxhash.xxh3_64_intdigest(data))
    path.write_bytes(encode_head(head, NO_STAMPS) + data + chunk(1)[1])
    assert [h.number for h in whole(path)] == [0, 1]
    path.write_bytes(bytes(PAGE) + data + chunk(1)[1])  # the head was never written
    assert [h.number for h in whole(path)] == [1]


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_damage_and_never_a_fault(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "0000.seg"
    segment(path, 6)
    data, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
    for _ in range(40):
        at, n = int(rng.integers(len(data))), int(rng.integers(1, 3000))
        data[at : at + n] = rng.bytes(len(data[at : at + n]))
    path.write_bytes(data[: int(rng.integers(len(data)))])
    covered = 0
    for found in scan(path):
        assert found.offset >= covered
        covered = found.offset + (found.head.payload if isinstance(found, Chunk) else found.length)


def test_chunk_sizes() -> None:
    assert chunk_ticks(12_500, 20_000) == 1024
    assert chunk_ticks(12_500, 40_000) == 1024
    assert chunk_ticks(13_000, 40_000) % 512 == 0
    assert chunk_ticks(128_000, 20_000) * 128_000 <= 12_800_000
    for tick_bytes in (1, 7, 768, 12_500, 13_000, 128_000, 16_385):
        ticks = chunk_ticks(tick_bytes, 20_000)
        assert (ticks * tick_bytes) % PAGE == 0
    odd = chunk_ticks(99_999, 20_000)  # 4096 of these would be 400 MB: padded instead
    assert odd == 128
    with pytest.raises(UsageError):
        chunk_ticks(0, 1.0)


def test_stamps_are_thinned_evenly_and_end_with_the_last() -> None:
    table = stamps(1000, 12_000_000)
    few = thinned(table)
    assert len(few) <= MAX_STAMPS
    assert few["end"][-1] == table["end"][-1]
    assert np.diff(few["end"].astype(int)).max() < 2.2 * np.diff(few["end"].astype(int)).min()
    with pytest.raises(UsageError, match="too many"):
        encode_head(chunk(0)[0], table)
