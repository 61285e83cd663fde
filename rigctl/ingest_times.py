"""When things of a take happened, in rig time: the spike stream's bytes, and the frames of clips."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.clock import fit_rig
from spikerig.calib.clock_maps import Clocks
from spikerig.calib.panel_read import Spot
from spikerig.dataset.clocktime import NS, ClockModel
from spikerig.dataset.errors import DataError, RefusedError
from spikerig.dataset.framing import confidence_of, find_phase, seam_scores
from spikerig.dataset.gopro_file import GoProClip
from spikerig.dataset.marks import Sight, read_marks
from spikerig.dataset.rawtake import RawTake, WireBytes, read_lines
from spikerig.rigctl.panel_framing import MOST_TICKS, best_of, panel_scores

LATE_TICKS = 1  # a tick's bytes leave during the tick after it was exposed (assumed: docs/hardware/vidar.md)
SURE, VERY_SURE = 0.9, 0.999  # a framing that is less likely is not believed; one that is more ends the search
PHASE_TICKS = 512  # looked at for the framing


@dataclass(frozen=True, slots=True)
class RgbTimes:
    """How a clip's media time becomes rig time, and where that is from: "sights" or "truth"."""

    model: ClockModel
    how: str


class Times:
    """Rig time of a take.

    Args:
        take: with marks of its clocks.
        truth: of an emulated rig, one a session; for clips whose panel was not read.

    Raises:
        DataError: no marks that tie a clock to the rig's.
    """

    def __init__(self, take: RawTake, truth: list[Mapping[str, Any]]) -> None:
        self.marks = list(read_marks(take.folder / "marks.jsonl"))
        self.take, self.truth = take, truth
        self.missing: dict[str, str] = {}
        self.fit([])

    def fit(self, sights: Iterable[Sight]) -> None:
        """Fit all clocks anew, with sightings beside the marks of the take."""
        self.marks += sights
        self.clocks: Clocks = fit_rig(self.marks)
        self.sighted = {(m.clock, m.epoch) for m in self.marks if isinstance(m, Sight)}

    def spike(self, epoch: int, at_ns: int) -> ClockModel:
        """Rig time from the spike camera's own, near a time of an epoch."""
        return self.clocks.fit("spike", epoch, at_ns).model

    def rgb(self, clip: GoProClip, name: str, host_ns: int) -> RgbTimes:
        """Rig time from a clip's media time.

        Args:
            clip, name: the clip, and its name on the card.
            host_ns: when it was started.

        Raises:
            RefusedError: nothing ties it to the rig.
        """
        number = clip_number(name)
        if ("rgb", number) in self.sighted:
            return RgbTimes(self.clocks.fit("rgb", number, int(clip.start_ns[0])).model, "sights")
        found = [] if self.take.plan.get("sync", {}).get("mode") == "optical" else [
            (session, row)
            for session in self.truth
            for row in session.get("rgb", ())
            if row.get("event") == "clip" and row["number"] == number
            and session["start_ns"] <= host_ns <= session["end_ns"]
        ]  # fmt: skip
        if not found:
            raise RefusedError(
                "nothing ties this clip's frames to the rig's time", value=name,
                expected="the LED panel, or the LED, in its view",
                next="spikerig rig panel TAKE SPOTS.json reads a panel; without it frames and spikes cannot be paired",
            )  # fmt: skip
        session, row = found[-1]
        media, true = np.array(row["media_ns"], np.int64), np.array(row["true_ns"], np.int64)
        rig = self.rig_from_true(session, true)
        return RgbTimes(ClockModel(media, rig, np.full(len(media), 1000.0)), "truth")

    def rig_from_true(self, session: Mapping[str, Any], true_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rig time at true times of an emulated session.

        Raises:
            RefusedError: the session does not tell: without a clock box, one of several epochs of the spike stream.
        """
        return self._true_model(session).rig_from_device(true_ns)

    def true_from_rig(self, session: Mapping[str, Any], rig_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The way back."""
        return self._true_model(session).device_from_rig(rig_ns)

    def _true_model(self, session: Mapping[str, Any]) -> ClockModel:
        box = session.get("box")
        if self.clocks.rig == "box" and box:
            knots, off = np.array(box["clock"], np.int64), 0
        else:
            knots, off = (
                np.array(session.get("spike_clock") or (), np.int64).reshape(-1, 2),
                self._stream_began(session),
            )
        return ClockModel(knots[:, 0], knots[:, 1] - np.int64(off + self.clocks.origin_ns), np.zeros(len(knots)))

    def _stream_began(self, session: Mapping[str, Any]) -> int:
        """The camera's own time at the first byte of the epoch, of a take of one session and one epoch."""
        ends = [told for _, told in read_lines(self.take.folder / "log.jsonl") if told.get("kind") == "end"]
        if len(ends) != 1 or ends[0].get("epoch") != 0 or not session.get("spike_clock"):
            raise RefusedError(
                "an emulated take without a clock box tells its truth of one epoch only", value=self.clocks.rig,
                next="--no-truth",
            )  # fmt: skip
        profile = self.take.profile
        first = int(session["spike"][0]["sent"][-1][1]) - int(ends[0]["bytes"])
        return round(first / profile.tick_bytes / profile.rate_hz * NS)


def clip_number(name: str) -> int:
    """The number in a clip's name, GX01nnnn.MP4.

    Raises:
        DataError: it is no such name.
    """
    found = re.fullmatch(r".*G[A-Z]\d\d(\d{4})\.MP4", name, re.IGNORECASE)
    if not found:
        raise DataError("a clip's name is not a GoPro's", value=name, expected="GX01nnnn.MP4")
    return int(found[1])


def read_truth(take: RawTake) -> list[Mapping[str, Any]]:
    """What an emulated rig told of its sessions; empty for a real one.

    Raises:
        DataError: damaged.
    """
    path = take.folder / "truth.json"
    if not path.exists():
        return []
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(told, list) or not all(isinstance(s, dict) for s in told):
            raise ValueError("not a list of sessions")
    except (OSError, ValueError, RecursionError) as error:
        raise DataError("the emulated rig's truth is damaged", value=f"{path}: {error}") from error
    return told


class Framing:
    """Where ticks begin in each epoch: found once, from the pictures that the bits hold.

    Args:
        wire: the bytes.
        spans: (epoch, first byte, byte past the last) of viewpoints: one whose picture tells is enough.
        pairs: the panel's LEDs and their complements in the spike camera's picture; empty without a panel.
    """

    def __init__(
        self, wire: WireBytes, spans: Iterable[tuple[int, int, int]], pairs: Sequence[tuple[Spot, Spot]] = ()
    ) -> None:
        self.wire, self.profile, self.spans = wire, wire.take.profile, list(spans)
        self.pairs = pairs if self.profile.framing == "none" else ()
        self._offset: dict[int, int] = {}

    def offset(self, epoch: int) -> int:
        """Byte of an epoch, modulo a tick, at which ticks begin.

        Raises:
            RefusedError: no picture tells, or two that seem sure differ.
        """
        if epoch not in self._offset:
            told = self._by_panel(epoch) if self.pairs else self._by_seam(epoch)
            if told is None:
                raise RefusedError(
                    "where ticks begin cannot be told", value=f"epoch {epoch}",
                    cause="dark, uniform or noisy pictures, or a panel that is not where the plan says",
                    next="spikerig rig probe tests the wire profile",
                )  # fmt: skip
            self._offset[epoch] = told
        return self._offset[epoch]

    def _stretches(self, epoch: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """First bytes and whole stretches of an epoch's viewpoints."""
        for _, start, stop in [s for s in self.spans if s[0] == epoch]:
            data, missing = self.wire.read(epoch, start, min(stop, start + MOST_TICKS * self.profile.tick_bytes))
            if not missing and len(data) >= 16 * self.profile.tick_bytes:
                yield start, data

    def _by_seam(self, epoch: int) -> int | None:
        sure: set[int] = set()
        size = self.profile.tick_bytes
        total = np.zeros(size)
        for start, data in self._stretches(epoch):
            piece = data[: PHASE_TICKS * size]
            phase = find_phase(piece, self.profile)
            if phase.confidence >= SURE:
                sure.add((start + phase.offset) % size)
            if len(sure) == 1 and phase.confidence > VERY_SURE:
                break
            if self.profile.framing == "none":
                total += np.roll(seam_scores(piece, self.profile), start % size)
        if sure:
            return sure.pop() if len(sure) == 1 else None
        # no picture tells by itself: what all of them say together, if it is said clearly
        best = int(np.argmax(total))
        return best if confidence_of(total, best) > VERY_SURE else None

    def _by_panel(self, epoch: int) -> int | None:
        total = np.zeros(self.profile.tick_bytes)
        best, sure = 0, False
        for seen, (start, data) in enumerate(self._stretches(epoch)):
            scores = panel_scores(data, self.profile, self.pairs)
            if scores is not None:
                total += np.roll(scores, start % self.profile.tick_bytes)
            best, sure = best_of(total, self.profile)
            if sure and seen >= 2:
                break
        return best if sure else None
