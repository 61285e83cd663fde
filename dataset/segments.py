"""Raw segments of a take: a spike camera's bytes as they came, in chunks that each tell by themselves what they are.

A segment file is a row of chunks; a chunk is a header of 4096 bytes and a payload, padded with zeros to a multiple of
4096. Every header and every payload has a checksum, so whatever a crash left whole can be read, without any index.
Layout and promises: docs/format.md. Writing is in `rigctl.recorder`; here are the pure functions of both directions.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from math import gcd
from pathlib import Path
from typing import BinaryIO

import numpy as np
import xxhash
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, HostError, UsageError

PAGE = 4096  # headers, payloads and memory are aligned to this, as O_DIRECT asks
MAGIC, VERSION = b"SPKSEG\x01\n", 1
TARGET_BYTES, TARGET_S = 12_800_000, 0.0512  # a chunk: 1024 ticks of 400x250 at 20 kHz
MAX_PAYLOAD = 1 << 27  # a header that tells more is not believed
STAMPS_AT, MAX_STAMPS, SEALED = 256, 190, PAGE - 8
STAMP = np.dtype([("end", "<u4"), ("before_ns", "<i8"), ("after_ns", "<i8")])
_HEAD = struct.Struct("<8sHHIQQQQQqqQQQIIQ16sQ")
_SEAL = struct.Struct("<Q")
_STEP = 1 << 22  # bytes looked through at a time where the next header has to be found


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What a chunk says of itself.

    Args:
        take: 64-bit number of the take; a chunk of another one is not believed.
        number: of the chunk in the take, from 0; each one by 1 higher than the one before.
        epoch: of the stream; within one no byte is missing but `lost_recorder` and `skipped`.
        byte_index: of the payload's first byte in the epoch.
        tick_bytes: bytes a tick.
        first_ns, last_ns: host time before the first transfer was asked for, and after the last one came.
        lost_transport: bytes that the link lost just before this chunk, as far as is known; also 0 if unknown.
        lost_recorder: bytes that came and that the recorder could not keep, just before this chunk: exact.
        skipped: bytes that came and were not wanted, just before this chunk, as between two viewpoints: exact.
        why: what told of the loss, at most 16 ASCII letters.
        suspect: bytes at the end of the epoch before among which a loss on the link may lie.
        payload: bytes.
        digest: xxh3_64 of the payload.
    """

    take: int
    number: int
    epoch: int
    byte_index: int
    tick_bytes: int
    first_ns: int
    last_ns: int
    lost_transport: int = 0
    lost_recorder: int = 0
    skipped: int = 0
    why: str = ""
    suspect: int = 0
    payload: int = 0
    digest: int = 0

    @property
    def tick(self) -> int:
        """The first tick of the epoch that begins in this chunk or later."""
        return -(-self.byte_index // self.tick_bytes)

    @property
    def stored(self) -> int:
        """Bytes of the payload on disk, with padding."""
        return padded(self.payload)


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk found in a file: its head, the host stamps of its transfers, and where its payload is.

    `stamps` has the fields `end` (payload bytes up to the transfer's end), `before_ns` and `after_ns`.
    """

    head: ChunkHead
    stamps: NDArray[np.void]
    path: Path
    offset: int

    def read(self) -> NDArray[np.uint8]:
        """The payload, checked.

        Raises:
            DataError: the bytes are not those that were written.
        """
        with _opened(self.path) as file:
            file.seek(self.offset)
            data = np.frombuffer(file.read(self.head.payload), np.uint8)
        if len(data) != self.head.payload or xxhash.xxh3_64_intdigest(data.data) != self.head.digest:
            raise DataError(
                "a chunk's bytes are damaged",
                value=f"{self.path}, chunk {self.head.number} at {self.offset}",
                next=f"spikerig data verify {self.path.parent.parent}",
            )
        return data


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes of a segment that are no whole chunk: where, how many, and what is wrong."""

    path: Path
    offset: int
    length: int
    why: str


def padded(size: int) -> int:
    """A size rounded up to whole pages."""
    return -(-size // PAGE) * PAGE


def chunk_ticks(tick_bytes: int, rate_hz: float) -> int:
    """Ticks of a whole chunk: about 51.2 ms or 12.8 MB, the smaller, so that the payload is whole pages.

    Args:
        tick_bytes: on the wire.
        rate_hz: ticks a second.

    Edges:
        Never less than the fewest ticks that fill whole pages, unless those were over 128 MB: then as many ticks as
        fit 12.8 MB, at least one, and the payload is padded.
    """
    if tick_bytes < 1 or not rate_hz > 0:
        raise UsageError("a tick has bytes, and a rate is positive", value=(tick_bytes, rate_hz))
    unit = PAGE // gcd(PAGE, tick_bytes)
    wanted = min(TARGET_BYTES / tick_bytes, rate_hz * TARGET_S)
    if unit * tick_bytes > MAX_PAYLOAD:
        return max(1, int(wanted))
    return max(1, round(wanted) // unit) * unit


def encode_head(head: ChunkHead, stamps: NDArray[np.void]) -> bytes:
    """A chunk's first 4096 bytes.

    Raises:
        UsageError: a number does not fit, or there are more than 190 stamps (`thinned` helps).
    """
    if len(stamps) > MAX_STAMPS:
        raise UsageError("too many stamps for a header", value=len(stamps), expected=f"at most {MAX_STAMPS}")
    why = head.why.encode("ascii", "replace")[:16]
    try:
        fields = _HEAD.pack(
            MAGIC, VERSION, len(stamps), head.tick_bytes, head.take, head.number, head.epoch, head.byte_index,
            head.tick, head.first_ns, head.last_ns, head.lost_transport, head.lost_recorder, head.skipped,
            head.payload, head.stored, head.digest, why, head.suspect,
        )  # fmt: skip
    except struct.error as error:
        raise UsageError("a chunk's numbers do not fit its header", value=f"{head}: {error}") from None
    table = np.ascontiguousarray(stamps, STAMP).tobytes()
    body = (fields.ljust(STAMPS_AT, b"\0") + table).ljust(SEALED, b"\0")
    return body + _SEAL.pack(xxhash.xxh3_64_intdigest(body))


def decode_head(data: bytes) -> tuple[ChunkHead, NDArray[np.void]] | None:
    """The head and stamps in 4096 bytes; None where they are no header, a damaged one, or one that contradicts itself.

    Raises:
        DataError: a whole header of a newer version.
    """
    if len(data) != PAGE or not data.startswith(MAGIC):
        return None
    if _SEAL.unpack_from(data, SEALED)[0] != xxhash.xxh3_64_intdigest(data[:SEALED]):
        return None
    _, version, count, tick_bytes, take, number, epoch, byte_index, tick, first, last, *rest = _HEAD.unpack_from(data)
    transport, recorder, skipped, payload, stored, digest, why, suspect = rest
    if version > VERSION:
        raise DataError("a chunk of a newer version", value=version, expected=str(VERSION), next="update spikerig")
    text = why.rstrip(b"\0").decode("ascii", "replace")
    if tick_bytes < 1 or not 0 < payload <= MAX_PAYLOAD or count > MAX_STAMPS:
        return None
    head = ChunkHead(
        take,
        number,
        epoch,
        byte_index,
        tick_bytes,
        first,
        last,
        transport,
        recorder,
        skipped,
        text,
        suspect,
        payload,
        digest,
    )
    stamps = np.frombuffer(data, STAMP, count, STAMPS_AT)
    ends = stamps["end"].astype(np.int64)
    if stored != head.stored or tick != head.tick or np.any(np.diff(ends) <= 0) or (ends > payload).any():
        return None
    return head, stamps


def thinned(stamps: NDArray[np.void], most: int = MAX_STAMPS) -> NDArray[np.void]:
    """At most that many of the stamps, evenly taken, the last one always."""
    if len(stamps) <= most:
        return stamps
    return stamps[np.unique(np.linspace(0, len(stamps) - 1, most).round().astype(int))]


def scan(path: str | Path, *, take: int | None = None, verify: bool = True) -> Iterator[Chunk | Damage]:
    """Every whole chunk of a segment in order, and what between them is none; nothing is believed unchecked.

    Args:
        path: of the segment; it may be torn, cut short, or foreign.
        take: number of the take, if known.
        verify: check payloads too; without, only headers are read (and `Chunk.read` checks).

    Raises:
        UsageError: no such file.
        HostError: it cannot be read.
        DataError: a chunk of a newer version.

    Edges:
        Zeros after the last chunk are room that was set aside, not damage. After damage the next header is looked for
        at every page.

    Cost:
        One payload of memory; with `verify` the disk's speed.
    """
    path = Path(path)
    with _opened(path) as file:
        size, at, last = path.stat().st_size, 0, -1
        while at < size:
            found = _chunk_at(file, path, at, size, take, last, verify)
            if isinstance(found, Chunk):
                yield found
                last = found.head.number
                at = found.offset + found.head.stored
                continue
            after, dirty = _next_head(file, at + (PAGE if found else 0), size)
            if dirty or found:
                yield Damage(path, at, after - at, found or "no chunk begins here")
            at = after


def _chunk_at(file: BinaryIO, path: Path, at: int, size: int, take: int | None, last: int, verify: bool) -> Chunk | str:
    """The chunk at an offset; or why there is none, "" where there is not even a header."""
    file.seek(at)
    decoded = decode_head(file.read(PAGE))
    if decoded is None:
        return ""
    head, stamps = decoded
    if take is not None and head.take != take:
        return "a chunk of another take"
    if head.number <= last:
        return f"chunk {head.number} after chunk {last}"
    if at + PAGE + head.payload > size:
        return f"chunk {head.number} is cut short"
    if verify:
        data = file.read(head.payload)
        if len(data) != head.payload or xxhash.xxh3_64_intdigest(data) != head.digest:
            return f"chunk {head.number}: its bytes do not match its checksum"
    return Chunk(head, stamps, path, at + PAGE)


def _next_head(file: BinaryIO, start: int, size: int) -> tuple[int, bool]:
    """Where the next whole header is (or the end), and whether anything but zeros lies before it."""
    mark, at, dirty = np.frombuffer(MAGIC, "<u8")[0], start, False
    while at < size:
        file.seek(at)
        data = file.read(min(_STEP, size - at))
        if not data:
            break
        whole = len(data) // PAGE * PAGE
        words = np.frombuffer(data[:whole], "<u8")
        for page in np.flatnonzero(words[:: PAGE // 8] == mark):
            offset = int(page) * PAGE
            if decode_head(data[offset : offset + PAGE]) is not None:
                return at + offset, dirty or bool(words[: offset // 8].any())
        dirty = dirty or bool(np.frombuffer(data, np.uint8).any())
        at += len(data)
    return size, dirty


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except FileNotFoundError as error:
        raise UsageError("there is no such segment", value=path) from error
    except OSError as error:
        raise HostError("the segment cannot be read", value=f"{path}: {error.strerror}") from error
