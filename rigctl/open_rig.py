"""Opening the rig that a plan asks for: real devices, or an emulated rig."""

from __future__ import annotations

from pathlib import Path

from spikerig.dataset.errors import DeviceError
from spikerig.dataset.rawtake import read_lines
from spikerig.dataset.terminal import note
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.take_plan import TakePlan
from spikerig.rigctl.tally import Rig


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
    from spikerig.rigctl.serial_ports import find, serial_opener
    from spikerig.rigctl.syncbox import HarpBox
    from spikerig.rigctl.vidar import VidarSource

    host = RealHost()
    spike = VidarSource(plan.profile, host, serial=plan.spike.serial)
    box = None
    try:
        if plan.sync.mode == "box":
            port = plan.sync.port or _only(*find(host))
            box = HarpBox(serial_opener(port), host, address=port)
        rgb = None
        if plan.rgb.use:
            from spikerig.rigctl.gopro import open_gopro

            rgb = open_gopro(host, link=plan.rgb.link, name=plan.rgb.camera, say=note)
    except BaseException:
        spike.close()
        if box is not None:
            box.close()
        raise
    return Rig(host, spike, rgb, box)


def _only(boxes: list[DeviceFacts], reasons: list[str]) -> str:
    """The port of the only clock box there is."""
    if len(boxes) != 1:
        raise DeviceError(
            "no clock box is found" if not boxes else "there are several clock boxes",
            value="; ".join(reasons) or ", ".join(b.address for b in boxes) or None,
            next='plug it in, name its port in [sync] port, or set [sync] mode = "optical"',
        )
    return boxes[0].address


def _last_ns(take: Path) -> int:
    """The newest host time in a take's views and log; 0 without any."""
    lines = [told for name in ("views.jsonl", "log.jsonl") for _, told in read_lines(take / name)]
    return max((int(t.get("stop_ns") or t.get("host_ns") or 0) for t in lines), default=0)
