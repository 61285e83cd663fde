"""Sensor presets: effects and settings from published numbers, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Preset:
    """One camera as published.

    Args:
        arm: `spike` or `rgb`.
        source: of the numbers.
        effects: tables as in a scene file's list.
        settings: defaults of the arm's table ([sensor] or [rgb]) that differ.
    """

    arm: str
    source: str
    effects: tuple[Mapping[str, Any], ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


PRESETS: Mapping[str, Preset] = {
    "vidar-ideal": Preset("spike", "the integrate-and-fire definition (SpikeNVS Eq. 5 and 6), nothing else"),
}


def preset_names(arm: str) -> tuple[str, ...]:
    """Names of the presets of an arm, after the empty name of none."""
    return ("", *(name for name, preset in PRESETS.items() if preset.arm == arm))


def preset_effects(*names: str) -> list[Mapping[str, Any]]:
    """The effect tables of presets, in order; empty names give none."""
    return [table for name in names if name for table in PRESETS[name].effects]
