"""Wire profiles of the spike cameras that are known, users' own from TOML, and what a link can carry."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.wire import Sure, WireProfile

FT601_SUSTAINED, FT601_BUS = 360e6, 400e6  # bytes a second: measured by apertus' ft60x-rs; 32 bit x 100 MHz
QSFP40 = 5.0e9  # 40 Gbit/s, the vendor's capture card

# Where each certainty comes from is told in docs/hardware/vidar.md, which a test keeps equal to this table.
_VIDAR: Mapping[str, Sure] = MappingProxyType({
    "width": "documented", "height": "documented", "row_bits": "assumed", "rate_hz": "documented",
    "framing": "assumed", "bottom_up": "documented", "vendor": "assumed", "product": "assumed",
    "packet_bytes": "documented", "link_bytes_s": "documented",
})  # fmt: skip
_M1K40: Mapping[str, Sure] = MappingProxyType({**_VIDAR, "row_bits": "documented", "framing": "documented"})


def _vidar(rate: int, row_bits: int) -> WireProfile:
    name = f"vidar-400x250-{rate // 1000}k" + ("-416" if row_bits == 416 else "")
    return WireProfile(name, 400, 250, row_bits, float(rate), link_bytes_s=FT601_SUSTAINED, sure=_VIDAR)


PROFILES: Mapping[str, WireProfile] = MappingProxyType({
    p.name: p
    for p in (
        *(_vidar(rate, bits) for rate in (20_000, 40_000) for bits in (400, 416)),
        WireProfile(
            "m1k40-1000x1000-20k", 1000, 1000, 1024, 20_000.0, "m1k40", bottom_up=False, link_bytes_s=QSFP40,
            sure=_M1K40,
        ),
    )
})  # fmt: skip
DEFAULT = "vidar-400x250-20k"


def profile_named(name: str) -> WireProfile:
    """A profile by its name, or from a TOML file by its path.

    Raises:
        UsageError: neither a profile nor a file.
        DataError: the file is no profile; see `read_profile`.
    """
    if name in PROFILES:
        return PROFILES[name]
    if name.endswith(".toml"):
        return read_profile(Path(name))
    raise UsageError("no such wire profile", value=name, expected=", ".join(PROFILES) + ", or a TOML file")


def read_profile(path: Path) -> WireProfile:
    """A user's own profile: the fields of `WireProfile` as TOML keys, `like` to start from a known one.

    Raises:
        UsageError: there is no such file, or the sizes do not hold together.
        DataError: it is no TOML, or a key or value is wrong; all faults at once.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError("the profile cannot be read", value=f"{path}: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataError("the profile is no TOML", value=path, cause=str(error)) from error
    return profile_of(table, str(path))


def profile_of(table: Mapping[str, Any], where: str) -> WireProfile:
    """A profile from a parsed table; see `read_profile`."""
    told: dict[str, Any] = dict(table)
    like = told.pop("like", "")
    if like and like not in PROFILES:
        raise DataError("`like` names no known profile", value=f"{where}: {like!r}", expected=", ".join(PROFILES))
    kinds = {f.name: str(f.type) for f in dataclasses.fields(WireProfile)}
    wrong = [f"{key} = {value!r}" for key, value in told.items() if not _fits(kinds.get(key, ""), key, value)]
    needed = () if like else ("name", "width", "height", "row_bits", "rate_hz")
    wrong += [f"{key} is missing" for key in needed if key not in told]
    if wrong:
        raise DataError("the profile has wrong entries", value=f"{where}: " + "; ".join(wrong),
                        expected=", ".join(f"{k}: {v}" for k, v in kinds.items()))  # fmt: skip
    told |= {k: float(v) for k, v in told.items() if kinds[k] == "float"}
    if not like:
        return WireProfile(**told)
    base = PROFILES[like]
    said = {k: v for k, v in base.sure.items() if k not in told}  # what a user overrides is the user's own claim
    return dataclasses.replace(base, **{"name": f"{like}*", **told, "sure": {**said, **told.get("sure", {})}})


def _fits(kind: str, key: str, value: Any) -> bool:
    if key == "sure":
        names = {f.name for f in dataclasses.fields(WireProfile)}
        return isinstance(value, dict) and all(
            k in names and v in ("verified", "documented", "assumed") for k, v in value.items()
        )
    if key == "framing":
        return value in ("none", "m1k40")
    wanted = {"str": (str,), "int": (int,), "float": (int, float), "bool": (bool,)}.get(kind, ())
    return isinstance(value, wanted) and (kind == "bool" or not isinstance(value, bool))


def check_link(profile: WireProfile) -> RigError | None:
    """Whether a profile's stream fits its link; the refusal with its numbers, or None."""
    need, can = profile.bytes_s, profile.link_bytes_s
    if need <= can:
        return None
    most = can / profile.tick_bytes
    return UsageError(
        "the camera makes more bytes than its link can carry",
        value=f"{profile.name}: {profile.tick_bytes:,} B a tick x {profile.rate_hz:,.0f} Hz = {need / 1e6:,.0f} MB/s",
        expected=f"at most {can / 1e6:,.0f} MB/s sustained ({most:,.0f} ticks a second)"
        + (f"; the FT601's bus ends at {FT601_BUS / 1e6:.0f} MB/s" if can <= FT601_BUS else ""),
        cause="more bytes than fit are lost without any USB error",
        next="use the camera's slower mode (vidar-400x250-20k), or its PCIe link with its own profile",
    )
