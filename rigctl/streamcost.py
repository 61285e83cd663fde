"""`spikerig cost stream`: how fast spikes come against real time, and how much memory a long take holds."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from spikerig.dataset import machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note
from spikerig.rigctl.sim.stream import spike_blocks

RATE_HZ = 40_000
PICTURES = 8  # made once, and shown in turn
CASES: dict[str, tuple[float, dict[str, Any]]] = {  # brightest light, thresholds a tick, and the pixels
    "ideal": (0.6, {}),
    "bright, clipped": (3.0, {}),
    "bright, carried": (3.0, {"carry": True}),
    "reset loss": (0.6, {"reset_loss": 0.002}),
    "comparator noise": (0.6, {"comparator": (0.006, (1, 2))}),
    "shot noise": (0.6, {"shot": (560.0, (3, 4))}),
    "all three": (0.6, {"shot": (560.0, (3, 4)), "comparator": (0.006, (1, 2)), "reset_loss": 0.002}),
}


def stream_cost(height: int, width: int, *, ticks: int, every: int, block_ticks: int, rounds: int) -> dict[str, Any]:
    """Seconds of streams of spikes, all cases in turn, round after round.

    Args:
        height, width: of the pictures.
        ticks: of each stream.
        every: ticks between pictures; light is linear between them, dim to bright as its square.
        block_ticks: longest block.
        rounds: of which the fastest counts, for machines are shared.

    Returns:
        fill_bytes_per_second: of one thread that fills a block's memory with zeros; and rows: case, wall_seconds,
        cpu_seconds (of all threads), ticks_per_second and real_time (wall, of 40,000 ticks a second), ns_per_pixel_tick
        (CPU), fill_share (bytes of spikes a CPU second over those of filling), peak_bytes (of NumPy and Python, in a
        stream of its own).
    """
    best = dict.fromkeys(CASES, (np.inf, np.inf))
    fill = np.inf
    room = np.empty(min(block_ticks, ticks) * height * ((width + 7) // 8), np.uint8)
    bar = Progress("cost stream", rounds * len(CASES), "streams")
    runs = {name: _stream(name, height, width, ticks, every, block_ticks) for name in CASES}
    for _ in range(rounds):
        for name, run in runs.items():
            wall, cpu = _seconds(run)
            best[name] = min(best[name][0], wall), min(best[name][1], cpu)
            fill = min(fill, _seconds(partial(room.fill, 0))[0])
            bar.step(extra=name)
    size, rate = ticks * height * ((width + 7) // 8), room.size / fill
    return {
        "fill_bytes_per_second": rate,
        "rows": [
            {
                "case": name,
                "wall_seconds": wall,
                "cpu_seconds": cpu,
                "ticks_per_second": ticks / wall,
                "real_time": ticks / wall / RATE_HZ,
                "ns_per_pixel_tick": 1e9 * cpu / (ticks * height * width),
                "fill_share": size / cpu / rate,
                "peak_bytes": _peak(runs[name]),
            }
            for name, (wall, cpu) in best.items()
        ],
    }


def _stream(name: str, height: int, width: int, ticks: int, every: int, block_ticks: int) -> Callable[[], None]:
    top, pixel = CASES[name]
    rng = np.random.default_rng(0)
    pictures = [(top * rng.random((height, width)) ** 2).astype(np.float32) for _ in range(PICTURES)]
    start = rng.random((height, width))

    def light() -> Iterator[tuple[int, NDArray[np.floating]]]:
        for k in range(-(-ticks // every) + 1):
            yield min(k * every, ticks), pictures[k % PICTURES]

    def run() -> None:
        for _ in spike_blocks(light(), start, hold=False, block_ticks=block_ticks, pixel=pixel):
            pass

    return run


def _seconds(run: Callable[[], Any]) -> tuple[float, float]:
    """Wall and CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - wall, time.process_time() - cpu


def _peak(run: Callable[[], None]) -> int:
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def stream(
    width: Annotated[int, typer.Option(help="Of the pictures.")] = 400,
    height: Annotated[int, typer.Option(help="Of the pictures.")] = 250,
    seconds: Annotated[float, typer.Option(help="Of the rig's time, in each stream.")] = 0.1,
    every: Annotated[int, typer.Option(help="Ticks between pictures.")] = 40,
    block: Annotated[int, typer.Option(help="Longest block, ticks.")] = 1024,
    rounds: Annotated[int, typer.Option(help="The fastest of so many counts.")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Spikes from pictures: ticks a second against real time, share of the memory limit, memory held."""
    ticks = round(seconds * RATE_HZ)
    if min(width, height, ticks, every, block, rounds) < 1:
        raise UsageError(
            "sizes, ticks and rounds must be at least 1", value=(width, height, ticks, every, block, rounds)
        )
    done = stream_cost(height, width, ticks=ticks, every=every, block_ticks=block, rounds=rounds)
    where = machine.describe()
    if as_json:
        size = {"width": width, "height": height, "ticks": ticks, "every": every, "block": block, "rounds": rounds}
        emit("spikerig.cost.stream/1", {**done, **size, "machine": where, "command": machine.command()})
        return
    typer.echo(f"{'case':<18}{'ticks/s':>9}{'real time':>11}{'CPU ns/px/tick':>16}{'of fill':>9}{'peak MB':>9}")
    for row in done["rows"]:
        typer.echo(
            f"{row['case']:<18}{row['ticks_per_second']:>9.0f}{row['real_time']:>10.2f}x{row['ns_per_pixel_tick']:>16.3f}"
            f"{row['fill_share']:>9.2%}{row['peak_bytes'] / 1e6:>9.1f}"
        )
    note(
        f"{width}x{height}, {ticks} ticks, a picture every {every}; one thread fills "
        f"{done['fill_bytes_per_second'] / 1e9:.1f} GB/s; fastest of {rounds}; {machine.caption(where)}"
    )
