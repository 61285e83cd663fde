"""Small losses put back: a take's bytes numbered as the camera sent them, though time saw none of them missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes, read_lines
from spikerig.rigctl.slips import Missing, Spans, find_slips


class MendedBytes(WireBytes):
    """Spike bytes with small losses put back: numbered as the camera sent them; those around each loss are missing.

    Args:
        take: whose bytes.
        spans: of viewpoints, in bytes that came.

    Attributes:
        slips: what was found.
    """

    def __init__(self, take: RawTake, spans: Spans) -> None:
        super().__init__(take)
        self.slips: list[Missing] = []
        self.slips = find_slips(WireBytes(take), spans)
        self._doubtful = _doubtful_ends(take)

    def sent(self, epoch: int, byte: int) -> int:
        """The camera's number of a byte that came."""
        return byte + sum(s.lost for s in self.slips if s.epoch == epoch and s.before <= byte)

    def span(self, epoch: int) -> tuple[int, int]:
        """As of `WireBytes`, in bytes sent."""
        first, last = super().span(epoch)
        return self.sent(epoch, first), self.sent(epoch, last)

    def read(self, epoch: int, start: int, stop: int) -> tuple[NDArray[np.uint8], list[tuple[int, int]]]:
        """As of `WireBytes`, in bytes sent."""
        mine = [s for s in self.slips if s.epoch == epoch]
        if not mine:
            return super().read(epoch, start, stop)
        out = np.zeros(stop - start, np.uint8)
        missing: list[tuple[int, int]] = []
        begin, ahead, at = 0, 0, start
        for slip in [*mine, None]:
            end = stop if slip is None else slip.after + ahead
            a, b = max(start, begin + ahead), min(stop, end)
            if a < b:
                if a > at:
                    missing.append((at, a))
                data, holes = super().read(epoch, a - ahead, b - ahead)
                out[a - start : b - start] = data
                missing += [(x + ahead, y + ahead) for x, y in holes]
                at = b
            if slip is not None:
                begin, ahead = slip.before, ahead + slip.lost
        return out, missing + ([(at, stop)] if at < stop else [])

    def suspect(self, epoch: int, start: int, stop: int) -> list[tuple[int, int]]:
        """As of `WireBytes`, with those that a session's end left in doubt."""
        found = super().suspect(epoch, start, stop)
        end, bytes_ = self._doubtful.get(epoch, (0, 0))
        first, last = max(start, self.sent(epoch, end) - bytes_), min(stop, self.sent(epoch, end))
        return found + ([(first, last)] if first < last else [])


def mended(take: RawTake, views: Sequence[TakenView]) -> tuple[MendedBytes, list[TakenView]]:
    """A take's bytes with small losses put back, and its viewpoints with spans in bytes as the camera sent them."""
    wire = MendedBytes(take, [s for v in views for s in v.spikes])
    return wire, [
        replace(v, spikes=tuple((e, wire.sent(e, a), wire.sent(e, b)) for e, a, b in v.spikes)) for v in views
    ]


def _doubtful_ends(take: RawTake) -> dict[int, tuple[int, int]]:
    """Of each session's last epoch: bytes that came, and how many at their end may lie behind a loss."""
    try:
        return {
            int(told["epoch"]): (int(told["bytes"]), int(told.get("suspect_bytes", 0)))
            for _, told in read_lines(take.folder / "log.jsonl")
            if told.get("kind") == "end"
        }
    except (KeyError, TypeError, ValueError) as error:
        raise DataError("the take's log is damaged", value=f"{take.folder / 'log.jsonl'}: {error!r}") from error
