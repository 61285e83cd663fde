"""Opening the rig that a plan asks for: real devices, or an emulated rig."""

from __future__ import annotations

from pathlib import Path

from spikerig.dataset.rawtake import read_lines
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.record import Rig
from spikerig.rigctl.take_plan import TakePlan


def open_rig(plan: TakePlan, take: Path, emulate: str = "", resume: bool = False) -> Rig:
    """The devices of a plan, open.

    Args:
        plan: names them.
        take: folder of the take; an emulated RGB camera's card is TAKE.card beside it.
        emulate: file or name of an emulated rig; empty: the real one.
        resume: the take is gone on with: emulated time goes on after it.

    Raises:
        UsageError, DeviceError, HostError: a device is not there, is held by others, or is not what the plan says.
    """
    if emulate:
        from spikerig.rigctl.sim.emulate.rig import load_rig_spec, open_emulated

        card = take.absolute().with_name(take.name + ".card")
        after_ns = _last_ns(take) if resume else 0
        return open_emulated(load_rig_spec(emulate), plan, card=card, after_ns=after_ns)
    return _real(plan)


def _real(plan: TakePlan) -> Rig:
    from spikerig.rigctl.syncbox import HarpBox, find_port, serial_opener
    from spikerig.rigctl.vidar import VidarSource

    host = RealHost()
    spike = VidarSource(plan.profile, host, serial=plan.spike.serial)
    try:
        box = None
        if plan.sync.mode == "box":
            port = plan.sync.port or find_port(host)
            box = HarpBox(serial_opener(port), host, address=port)
        rgb = None
        if plan.rgb.use:
            from spikerig.rigctl.gopro import open_gopro

            rgb = open_gopro(host)
    except BaseException:
        spike.close()
        raise
    return Rig(host, spike, rgb, box)


def _last_ns(take: Path) -> int:
    """The newest host time in a take's views and log; 0 without any."""
    lines = [told for name in ("views.jsonl", "log.jsonl") for _, told in read_lines(take / name)]
    return max((int(t.get("stop_ns") or t.get("host_ns") or 0) for t in lines), default=0)
