"""Which field a config names; the only place that knows them all."""

from __future__ import annotations

from spikerig.train.config import FitConfig
from spikerig.train.field import Field


def field_of(config: FitConfig) -> Field:
    """The field a config names."""
    if config.field == "splat":
        from spikerig.train.splatfield import SplatField

        return SplatField()
    from spikerig.train.rayfield import RayField

    return RayField(config.field)
