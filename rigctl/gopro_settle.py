"""Bringing a GoPro to the rig's settings: in the order it takes, read back, and honest about what only a file shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spikerig.dataset.errors import DeviceError
from spikerig.rigctl.gopro_http import Dark, Web
from spikerig.rigctl.gopro_radio import Radio
from spikerig.rigctl.gopro_settings import BY_NAME, DEFAULTS, Setting, in_order
from spikerig.rigctl.gopro_watch import GoProWatch


def settle(watch: GoProWatch, settings: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """Bring the camera to the rig's settings, changed by `settings`; see gopro_settings.py for the names.

    Returns:
        `set`: taken, and read back; `not_set`: undocumented ones it refused; `file_tells`: undocumented ones it
        took, which only the clip's header shows (see `gopro_check.verify_clip`).

    Raises:
        UsageError: unknown names or options.
        DeviceError: a documented setting is refused or reads back otherwise; the camera is busy or gone.
    """
    chosen = in_order(DEFAULTS | dict(settings))
    _stop_hindsight(watch)
    watch.until_idle("settings")
    done: dict[str, dict[str, str]] = {"set": {}, "not_set": {}, "file_tells": {}}
    for setting, option, value in chosen:
        refused = _refused(watch.web, watch.radio, setting, value)
        if refused is None:
            done["set" if setting.documented else "file_tells"][setting.name] = option
        elif setting.documented:
            raise refused
        else:
            done["not_set"][setting.name] = option
        watch.until_idle(setting.name)
    _read_back(watch, done["set"], chosen)
    return done


def _stop_hindsight(watch: GoProWatch) -> None:
    """HindSight encodes all the time: until it is off, HTTP is dark and every other setting is refused."""
    hindsight = BY_NAME["hindsight"]
    off = hindsight.options["off"]
    if watch.radio is not None and watch.radio.settings([hindsight.number]).get(hindsight.number) != off:
        watch.radio.set(hindsight.number, off)


def _refused(web: Web, radio: Radio | None, setting: Setting, value: int) -> DeviceError | None:
    """Set one; None, or the refusal."""
    word = 1
    try:
        if radio is None:
            (web.set if setting.documented else web.set_undocumented)(setting.number, value)
            return None
        word = radio.set(setting.number, value)
        if word and setting.documented:
            web.set(setting.number, value)  # the radio only says no; over HTTP the camera says why
            return None
    except Dark:
        if radio is None:
            raise
    except DeviceError as error:
        return error
    return None if not word else DeviceError(
        "the camera refuses a setting", value=f"{setting.name} = {value}", cause=f"status {word}",
        next="the order of settings: docs/hardware/gopro.md",
    )  # fmt: skip


def _read_back(watch: GoProWatch, done: Mapping[str, str], chosen: list[tuple[Setting, str, int]]) -> None:
    wanted = {s.number: (s.name, option, value) for s, option, value in chosen if s.name in done}
    found = watch.radio.settings(wanted) if watch.radio is not None else watch.web.state()[1]
    wrong = [
        f"{name} = {option} reads back as {found.get(number)}"
        for number, (name, option, value) in wanted.items()
        if found.get(number) != value
    ]
    if wrong:
        raise DeviceError(
            "the camera did not keep its settings", value="; ".join(wrong),
            cause="a later setting changed an earlier one, or somebody touched the camera",
        )  # fmt: skip
