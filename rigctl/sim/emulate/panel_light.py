"""The LED panel as the emulated cameras see it: how much of a tick, or of a row's exposure, each LED is on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import fire
from spikerig.dataset.panel import Panel


def lit_ns(panel: Panel, at_ns: ArrayLike) -> NDArray[np.int64]:
    """How long each LED has been on since the panel's time 0, int64[..., L]: differences are on-times, exactly.

    Edges:
        Times before 0 give negative values; differences stay right.
    """
    at = np.asarray(at_ns, np.int64)[..., None]
    bit = np.array([max(led.bit, 0) for led in panel.leds], np.int64)
    step = np.int64(panel.step_ns)
    period = np.where(bit == panel.bits - 1, 2 << bit, 4 << bit) * step
    begin, length = (1 << bit) * step, np.where(bit == panel.bits - 1, 1 << bit, 2 << bit) * step
    on = at // period * length + np.clip(at % period - begin, 0, length)
    on = np.where([led.inverted for led in panel.leds], at - on, on)
    return np.where([led.bit < 0 for led in panel.leds], at, on)


@dataclass(frozen=True)
class PanelInView:
    """Where the panel stands in a picture.

    Args:
        panel: what it shows.
        centres_px: float64[L,2], x and y of each LED's centre.
        radius_px: of an LED's disk.
        light: of an LED that is on, in the picture's unit (spikes a tick, or linear RGB), added to what is there.
        height, width: of the picture.

    Raises:
        UsageError: centres do not fit the LEDs, an LED lights no pixel of the picture, or two light the same.
    """

    panel: Panel
    centres_px: NDArray[np.float64]
    radius_px: float
    light: float
    height: int
    width: int
    rows: NDArray[np.int64] = field(init=False)  # of the lit pixels
    columns: NDArray[np.int64] = field(init=False)
    led: NDArray[np.int64] = field(init=False)  # which LED lights them
    weight: NDArray[np.float64] = field(init=False)  # share of the pixel that its disk covers

    def __post_init__(self) -> None:
        centres = np.asarray(self.centres_px, np.float64)
        if centres.shape != (len(self.panel.leds), 2) or not np.isfinite(centres).all() or not self.radius_px > 0:
            raise UsageError("a panel in view needs a centre for each of its LEDs", value=centres.shape)
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        found = []
        for number, (cx, cy) in enumerate(centres):
            # A disk's edge falls off over one pixel: enough for light that is read as sums.
            cover = np.clip(self.radius_px + 0.5 - np.hypot(x - cx, y - cy), 0, 1)
            rows, columns = np.nonzero(cover)
            if not len(rows):
                raise UsageError("an LED of the panel is outside the picture", value=f"LED {number} at {cx}, {cy}")
            found.append((rows, columns, np.full(len(rows), number), cover[rows, columns]))
        for name, parts in zip(("rows", "columns", "led", "weight"), zip(*found, strict=True), strict=True):
            object.__setattr__(self, name, np.concatenate(parts))
        if len(np.unique(self.rows * self.width + self.columns)) < len(self.rows):
            raise UsageError(
                "LEDs of the panel overlap in the picture", value=f"radius {self.radius_px} px", next="a smaller radius"
            )

    def of_ticks(self, bounds_ns: ArrayLike) -> NDArray[np.float32]:
        """Light of the lit pixels in each tick: float32[T,N] for the T+1 panel times between ticks."""
        lit = lit_ns(self.panel, bounds_ns)
        share = np.diff(lit, axis=0) / np.diff(np.asarray(bounds_ns, np.int64))[:, None]
        return (self.light * share[:, self.led] * self.weight).astype(np.float32)

    def of_rows(self, start_ns: ArrayLike, exposure_ns: ArrayLike) -> NDArray[np.float32]:
        """Light of the lit pixels of one frame: float32[N]; `start_ns` int64[H], when each row's exposure starts.

        Args:
            start_ns: panel time of the start of each row.
            exposure_ns: panel time it lasts, a number or one a row.
        """
        start = np.broadcast_to(np.asarray(start_ns, np.int64), self.height)
        length = np.broadcast_to(np.asarray(exposure_ns, np.int64), self.height)
        on = lit_ns(self.panel, start + length) - lit_ns(self.panel, start)
        share = on[self.rows, self.led] / np.maximum(length[self.rows], 1)
        return (self.light * share * self.weight).astype(np.float32)


def with_panel(
    bits: NDArray[np.uint8],
    still: NDArray[np.floating],
    view: PanelInView,
    bounds_ns: ArrayLike,
    charge: NDArray[np.uint32] | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.uint32]]:
    """Spikes with the panel in them: the lit pixels of a stream are fired anew under their light and the panel's.

    Args:
        bits: uint8[T,H,ceil(W/8)], without the panel.
        still: float[H,W] light there, spikes a tick, taken as constant over these ticks.
        view: where the panel stands.
        bounds_ns: int64[T+1], panel times between ticks.
        charge: uint32[N] of the lit pixels, as the call before returned it; None: half a threshold.

    Returns:
        The bits, new, and the charge to go on with.
    """
    light = view.of_ticks(bounds_ns) + still[view.rows, view.columns].astype(np.float32)
    count = len(view.rows)
    state = np.full(count, 1 << 31, np.uint32) if charge is None else charge
    fired, left, _ = fire(light[:, None, :], np.arange(len(light) + 1), state[None], hold=True)
    spikes = np.unpackbits(fired[:, 0], axis=1, bitorder="little", count=count)
    made = bits.copy()
    # pixels share bytes: clear and set bit by bit, LED by LED
    byte, place = view.columns >> 3, (1 << (view.columns & 7)).astype(np.uint8)
    for n in range(count):
        column = made[:, view.rows[n], byte[n]]
        made[:, view.rows[n], byte[n]] = np.where(spikes[:, n], column | place[n], column & ~place[n])
    return made, left[0].astype(np.uint32)
