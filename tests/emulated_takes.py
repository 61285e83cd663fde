"""Small takes on the emulated rig, for tests of the loop and of what becomes of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spikerig.dataset.rawtake import open_take
from spikerig.rigctl.ingest_led import led_sights
from spikerig.rigctl.ingest_slips import mended
from spikerig.rigctl.ingest_times import Framing, Times, read_truth
from spikerig.rigctl.led_view import led_plan
from spikerig.rigctl.operator import Nobody
from spikerig.rigctl.record import record
from spikerig.rigctl.sim.emulate.rig import RigSpec, open_emulated
from spikerig.rigctl.sim.limits import Faults, read_record
from spikerig.rigctl.take_plan import TakePlan, read_plan
from spikerig.rigctl.tally import Rig, Tally

WIRE = {"name": "tiny", "width": 64, "height": 48, "row_bits": 64, "rate_hz": 20_000, "link_bytes_s": 3.6e8,
        "packet_bytes": 16384}  # fmt: skip
CRYSTALS = {"seed": 3, "spike": {"ppm": 21.0, "walk": 1e-8, "ram_bytes": 1 << 24}, "rgb": {"ppm": -33.0},
            "box": {"firmware": "pico", "ppm": 8.0, "start_second": 77}}  # fmt: skip


def plan_of(**more: Any) -> TakePlan:
    """Three viewpoints of 0.1 s, by itself."""
    table: dict[str, Any] = {
        "name": "small", "viewpoints": 3, "seconds": 0.1, "advance": "auto", "settle_s": 0.1, "tries": 2,
        "spike": {"wire": WIRE}, "rgb": {"lead_s": 0.03, "settings": {"shutter": "1/240"}},
        "checks": {"focus": 0.0, "spare_gb": 0.001}, "sync": {"probe_s": 0.1},
        "recorder": {"on_full": "wait", "ring_s": 0.3, "segment_mb": 4},
    }  # fmt: skip
    for key, value in more.items():
        table[key] = {**table[key], **value} if isinstance(value, Mapping) and key in table else value
    return read_plan(table)


def rig_of(plan: TakePlan, folder: Path, after_ns: int = 0, **more: Any) -> Rig:
    """The emulated rig, with more in its tables."""
    table: dict[str, Any] = {k: dict(v) if isinstance(v, dict) else v for k, v in CRYSTALS.items()}
    for key, value in more.items():
        table[key] = {**table.get(key, {}), **value} if isinstance(value, Mapping) else value
    faults = Faults("spec")
    spec = read_record(RigSpec, table, "", faults)
    faults.raise_any()
    return open_emulated(spec, plan, card=folder.with_name(folder.name + ".card"), after_ns=after_ns)


class Scripted:
    """Answers from a list, then the first key; remembers what was said and asked."""

    def __init__(self, answers: Sequence[str] = ()) -> None:
        self.answers, self.said, self.asked = list(answers), [], []  # type: ignore[var-annotated]

    def say(self, text: str) -> None:
        self.said.append(text)

    def ask(self, question: str, keys: Mapping[str, str]) -> str:
        self.asked.append((question, tuple(keys)))
        answer = self.answers.pop(0) if self.answers else next(iter(keys))
        assert answer in keys
        return answer


def take(folder: Path, plan: TakePlan | None = None, operator: Any = None, resume: bool = False, **more: Any) -> Tally:
    """Record a take on the emulated rig."""
    plan = plan or plan_of()
    rig = rig_of(plan, folder, **more)
    try:
        with rig.host.worker("main"):
            return record(plan, rig, folder, operator or Nobody(), resume=resume)
    finally:
        rig.close()


def led_clocks(folder: Path) -> tuple[Times, Any, Any]:
    """The clocks of a take by its LED, what was read of it, and what really happened."""
    raw = open_take(folder)
    times = Times(raw, read_truth(raw))
    wire, views = mended(raw, raw.views())
    led = led_plan(raw.plan)
    assert led is not None
    found = led_sights(raw, views, led, times.marks, wire, Framing(wire, [s for v in views for s in v.spikes]))
    times.fit(found.sights)
    return times, found, read_truth(raw)
