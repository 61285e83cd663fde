"""A capture plan: what to record at which viewpoints, as data."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import RigError, UsageError
from spikerig.dataset.segments import PAGE
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.led_view import LedPlan
from spikerig.rigctl.panel_view import PanelPlan
from spikerig.rigctl.profiles import DEFAULT, profile_named, profile_of
from spikerig.rigctl.recorder_options import OnFull, RecorderOptions
from spikerig.rigctl.sim.limits import Faults, limits, read_record

NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,62}")
SHIPPED = {"example": "plan.toml", "emulated": "plan_emulated.toml"}


@dataclass(frozen=True, slots=True)
class Spike:
    """`[spike]`: the spike camera.

    Args:
        profile: name of its wire profile (docs/hardware/vidar.md lists them), or a TOML file of one.
        wire: a profile written here instead, keys as in such a file.
        serial: of the camera, where there are several.
    """

    profile: str = limits(DEFAULT)
    wire: Any = limits(None)
    serial: str = limits("")


@dataclass(frozen=True, slots=True)
class Rgb:
    """`[rgb]`: the RGB camera.

    Args:
        use: there is one.
        link: "ble": started and stopped over Bluetooth; "hand": a person presses its button.
        camera: its Bluetooth name, where there are several.
        mbit_s: of its clips, for the estimate of bytes.
        card_gb: free on its card, as read from its screen; 0: not known before it is found.
        lead_s: before and after the spikes of a viewpoint the clip runs so much longer.
        settings: what it is set to, as its driver names things.
    """

    use: bool = limits(True)
    link: str = limits("ble", choices=("ble", "hand"))
    camera: str = limits("")
    mbit_s: float = limits(60.0, 0.1, 1000, "Mbit/s")
    card_gb: float = limits(0.0, 0, 100_000, "GB")
    lead_s: float = limits(0.5, 0, 60, "s")
    settings: Any = limits({})


@dataclass(frozen=True, slots=True)
class Sync:
    """`[sync]`: how the clocks are brought together.

    Args:
        mode: "box": a Harp clock box with the LED panel in both views; "optical": any plain blinking LED in both views
            (`[led]`), for the time between the two cameras alone; "none": nothing: frames and spikes are not paired.
        port: of the box; empty: the only one there is.
        probe_s: seconds between two questions to the box; 16 a second are what a minute of hold-over within 100 us
            needs (docs/clock.md).
    """

    mode: str = limits("box", choices=("box", "optical", "none"))
    port: str = limits("")
    probe_s: float = limits(0.06, 0.01, 60, "s")


@dataclass(frozen=True, slots=True)
class Checks:
    """`[checks]`: when a viewpoint is good enough; what is outside is told at once, with what to do.

    Args:
        exposure: mean spikes a tick and pixel, lowest and highest.
        saturated: greatest share of pixels that fire at 95 % of ticks or more.
        focus: least focus, as a share of the best viewpoint so far.
        sync_us: greatest residual of the clock box's probes.
        lost_ticks: most that a viewpoint may lose.
        spare_gb: of disk that is to stay free.
    """

    exposure: tuple[float, float] = limits((0.02, 0.7), 0, 1, "spikes a tick")
    saturated: float = limits(0.05, 0, 1)
    focus: float = limits(0.5, 0, 1)
    sync_us: float = limits(1000.0, 0, 1e6, "us")
    lost_ticks: int = limits(0, 0, 1_000_000_000)
    spare_gb: float = limits(2.0, 0, 100_000, "GB")


@dataclass(frozen=True, slots=True)
class Keeping:
    """`[recorder]`: between camera and disk; see `RecorderOptions`."""

    ring_s: float = limits(1.0, 0.1, 60, "s")
    memory_mb: float = limits(1500.0, 1, 1_000_000, "MB")
    on_full: str = limits("stop", choices=("stop", "drop", "wait"))
    segment_mb: float = limits(1074.0, 1, 1_000_000, "MB")
    sync_s: float = limits(1.0, 0, 60, "s")
    direct: bool = limits(True)
    watch: bool = limits(True)

    def options(self) -> RecorderOptions:
        """What the recorder takes."""
        full: OnFull = "stop" if self.on_full == "stop" else "drop" if self.on_full == "drop" else "wait"
        return RecorderOptions(
            self.ring_s, round(self.memory_mb * 1e6), full, round(self.segment_mb * 1e6) // PAGE * PAGE, self.sync_s,
            self.direct, self.watch,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Top:
    name: str = limits()
    viewpoints: Any = limits()
    seconds: float = limits(unit="s", lo=0.01, hi=86_400)
    advance: str = limits("prompt", choices=("prompt", "auto"))
    settle_s: float = limits(5.0, 0, 3600, "s")
    tries: int = limits(3, 1, 100)
    test_every: int = limits(0, 0, 1_000_000)
    spike: Any = limits({})
    rgb: Any = limits({})
    sync: Any = limits({})
    checks: Any = limits({})
    recorder: Any = limits({})
    panel: Any = limits(None)
    led: Any = limits(None)


@dataclass(frozen=True, slots=True)
class TakePlan:
    """A whole plan.

    Args:
        name: of the take.
        viewpoints: their names, in order.
        seconds: of spikes at each.
        advance: "prompt": each viewpoint waits for a key; "auto": each begins `settle_s` after the one before.
        settle_s: time to move the rig, where it advances by itself.
        tries: how often a viewpoint that fails its checks is taken, where it advances by itself.
        test_every: every n-th viewpoint, from the first, is held out of training in the scene; 0: none.
        profile: the wire of the spike camera.
        others: as in the file.
    """

    name: str
    viewpoints: tuple[str, ...]
    seconds: float
    advance: str
    settle_s: float
    tries: int
    test_every: int
    profile: WireProfile
    spike: Spike
    rgb: Rgb
    sync: Sync
    checks: Checks
    recorder: Keeping
    panel: PanelPlan | None = None
    led: LedPlan | None = None

    def as_json(self) -> dict[str, Any]:
        """The plan, whole, JSON-ready."""
        return {**asdict(replace(self, profile=replace(self.profile, sure={}))), "viewpoints": list(self.viewpoints)}


def load_plan(path: str | Path) -> TakePlan:
    """A plan from TOML, or a shipped one by name.

    Raises:
        UsageError: no such file, no TOML, or faults in it: all of them at once.
    """
    try:
        table = tomllib.loads(plan_text(path))
    except tomllib.TOMLDecodeError as error:
        raise UsageError("the plan is not valid TOML", value=f"{path}: {error}") from None
    return read_plan(table, str(path))


def plan_text(path: str | Path) -> str:
    """What a plan's file, or a shipped plan's, says; faults as `load_plan`."""
    if str(path) in SHIPPED:
        return files("spikerig.rigctl").joinpath(SHIPPED[str(path)]).read_text(encoding="utf-8")
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            "cannot read the plan", value=f"{path} ({getattr(error, 'strerror', None) or 'not UTF-8 text'})",
            expected=f"a TOML file, or a shipped plan: {', '.join(SHIPPED)}",
        ) from None  # fmt: skip


def read_plan(table: Mapping[str, Any], source: str = "the plan") -> TakePlan:
    """A plan from a parsed table; faults as `load_plan`."""
    faults = Faults(source, next="the keys, their units and ranges are in docs/operator.md")
    top = read_record(_Top, table, "", faults)
    spike = read_record(Spike, top.spike, "spike", faults)
    checks = read_record(Checks, top.checks, "checks", faults)
    if checks.exposure[0] > checks.exposure[1]:
        faults.add("checks.exposure", f"is {list(checks.exposure)}, expected [low, high]")
    if isinstance(top.name, str) and not NAME.fullmatch(top.name):
        faults.add("name", f"is {top.name!r}, expected letters, digits, `-`, `_`, `.`")
    rgb = read_record(Rgb, top.rgb, "rgb", faults)
    if not isinstance(rgb.settings, Mapping):
        faults.add("rgb.settings", f"is {rgb.settings!r}, expected a table")
    plan = (
        top.name, _names(top.viewpoints, faults), top.seconds, top.advance, top.settle_s, top.tries, top.test_every,
        _profile(spike, source, faults), spike, rgb, read_record(Sync, top.sync, "sync", faults), checks,
        read_record(Keeping, top.recorder, "recorder", faults),
        None if top.panel is None else read_record(PanelPlan, top.panel, "panel", faults),
        None if top.led is None else read_record(LedPlan, top.led, "led", faults),
    )  # fmt: skip
    panel, led = plan[-2:]
    if isinstance(led, LedPlan):
        for arm in ("spike", "rgb"):
            if len(getattr(led, arm)) % 2:
                faults.add(f"led.{arm}", f"is {list(getattr(led, arm))}, expected x and y of each LED")
    if isinstance(panel, PanelPlan) and panel.bits is not None and panel.slow >= panel.bits:
        faults.add("panel.slow", f"is {panel.slow}, expected below panel.bits, {panel.bits}")
    faults.raise_any()
    return TakePlan(*plan)  # pyright: ignore[reportArgumentType]  # without a profile there was a fault


def _profile(spike: Spike, source: str, faults: Faults) -> WireProfile | None:
    try:
        if spike.wire is not None:
            return profile_of(spike.wire, f"{source}: spike.wire")
        at = Path(source).parent / spike.profile
        return profile_named(str(at) if spike.profile.endswith(".toml") else spike.profile)
    except (RigError, TypeError, ValueError) as error:
        faults.add("spike.profile", str(error).replace("\n", ";"))
        return None


def _names(told: Any, faults: Faults) -> tuple[str, ...]:
    if isinstance(told, int) and not isinstance(told, bool) and 1 <= told <= 10_000:
        return tuple(f"{k:03d}" for k in range(told))
    if not (isinstance(told, list) and told and all(isinstance(n, str) and NAME.fullmatch(n) for n in told)):
        faults.add("viewpoints", f"is {told!r}, expected a number from 1 to 10000, or a list of names")
        return ()
    if len(set(told)) < len(told):
        faults.add("viewpoints", f"names {sorted({n for n in told if told.count(n) > 1})} more than once")
    return tuple(told)
