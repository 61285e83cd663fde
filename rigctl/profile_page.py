"""The tables of docs/hardware/vidar.md, made from the wire profiles."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.profiles import PROFILES, check_link

BEGIN, END = "<!-- made from rigctl/profiles.py: begin -->", "<!-- made from rigctl/profiles.py: end -->"
# field -> framing (or "" for any) -> where the certainty comes from
WHY: Mapping[str, Mapping[str, str]] = MappingProxyType({
    "width": {"": "SpikeCV's readers, public recordings"},
    "height": {"": "SpikeCV's readers, public recordings"},
    "row_bits": {
        "none": "SpikeCV reads 400, and 416 `with_head`; RSIR decodes its camera's dumps with 416. Which one a camera "
        "sends over USB is not written anywhere: `rig probe` tells",
        "m1k40": "two blocks of 64 bytes a row, in SpikeCV's SDK sources",
    },
    "rate_hz": {"": "modes 0x1000, 0x1001 and 0x2000 of the vendor's SDK header; the measured rate is what counts"},
    "framing": {
        "none": "no header, number or time was seen in recordings; of the USB stream itself there is no public source",
        "m1k40": "line and channel tags, in SpikeCV's SDK sources",
    },
    "bottom_up": {
        "none": "public readers flip; checked on a public recording",
        "m1k40": "no public reader of this camera flips",
    },
    "vendor": {"": "FTDI's own; a vendor may write another"},
    "product": {"": "FT601; the SDK's DLL loads FTD3XX, which also drives the FT600 (601e)"},
    "packet_bytes": {"": "`packetSize` of the SDK's Python example"},
    "link_bytes_s": {
        "none": "about 360 MB/s measured by apertus' ft60x-rs on an FT601; its bus ends at 400 MB/s",
        "m1k40": "a 40 Gbit/s capture card in the SDK's sources; not measured",
    },
})  # fmt: skip


def tables() -> str:
    """The generated part of the page: a table of profiles and links, and one of every field's certainty."""
    lines = ["| profile | tick | needs | link carries | |", "|---|---|---|---|---|"]
    for p in PROFILES.values():
        refused = check_link(p)
        fits = "fits" if refused is None else f"refused; the link ends at {p.link_bytes_s / p.tick_bytes:,.0f} ticks/s"
        lines.append(
            f"| `{p.name}` | {p.height} rows of {p.row_bits} bits, {p.tick_bytes:,} B | {p.bytes_s / 1e6:,.0f} MB/s "
            f"| {p.link_bytes_s / 1e6:,.0f} MB/s | {fits} |"
        )
    for framing, title in (("none", "400x250 (all four profiles)"), ("m1k40", "M1K40, 1000x1000")):
        kin = [p for p in PROFILES.values() if p.framing == framing]
        lines += ["", f"### {title}", "", "| field | value | sure | why |", "|---|---|---|---|"]
        for name, why in WHY.items():
            sure = kin[0].sure.get(name, "assumed")
            values = " or ".join(dict.fromkeys(_value(p, name) for p in kin))
            lines.append(f"| `{name}` | {values} | {sure} | {why.get(framing) or why['']} |")
    return "\n".join(lines)


def _value(profile: WireProfile, name: str) -> str:
    value = getattr(profile, name)
    if name in ("vendor", "product"):
        return f"{value:04x}"
    return f"{value:,.0f}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
