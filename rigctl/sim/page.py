"""The page docs/scenes.md, made from the records: `python -m spikerig.rigctl.sim.page > docs/scenes.md`."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

from spikerig.rigctl.sim.caster.pattern import Texture
from spikerig.rigctl.sim.caster.world import KINDS, Air, Lamp
from spikerig.rigctl.sim.events import EventCamera
from spikerig.rigctl.sim.orbit import Orbit
from spikerig.rigctl.sim.spec import PAPER, Cloud, Exposure, Lens, RgbCamera, Sensor, Shake, Tolerance

TABLES: tuple[tuple[str, type], ...] = (
    ("camera", Lens),
    ("orbit", Orbit),
    ("shake", Shake),
    ("exposure", Exposure),
    ("sensor", Sensor),
    ("rgb", RgbCamera),
    ("events", EventCamera),
    ("tolerance", Tolerance),
    ("points", Cloud),
    ("world.lamp", Lamp),
)

HEAD = """# Scene files

What `spikerig sim capture` plays: a TOML file, or the name of a built-in scene, which are the best examples
(`rigctl/sim/scenes/`: `demo`, `chroma`, and the six of [synthetic.md](synthetic.md)). Every key has a default unless it
says *required*. Unknown keys, wrong types and values out of range are told all at once. This page is made by
`python -m spikerig.rigctl.sim.page > docs/scenes.md`.

At the top: `name`; `seed` (of shake, noise and points; the world has its own seeds and does not change with it);
`effects`, a list of names or of tables `{ name = "...", parameter = value }`, each at most once; or the word `"auto"`,
which takes of those to choose from what matters for this scene, or `"all"` of them. To choose from are the effects of
the presets, and those listed in `consider` (same form), whose parameters go before a preset's. `spikerig sim effects`
says of a scene file which matter, and why: [effects.md](effects.md).

World axes: z up, right-handed. All light and reflectances are linear, 1.0 is display white.
"""


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for name, record in TABLES:
        parts.append(f"## `[{name}]`\n\n{about(record)}{rows(record)}")
    preset = ", ".join(f"`{k} = {_value(v)}`" for k, v in PAPER.items())
    parts.append(f'`protocol = "paper"` changes these defaults: {preset}, `sensor.gain = 0.5`.\n')
    parts.append("## `[world]`\n\n" + about(Air) + rows(Air))
    for kind, record in KINDS.items():
        parts.append(f'### `[[world.solids]]`, `kind = "{kind}"`\n\n{about(record)}{rows(record)}')
    parts.append(
        f"### Textures: `texture`, `floor`, `ceiling`, `walls`, `bark`, `leaf`\n\n{about(Texture)}{rows(Texture)}"
    )
    parts.append("## Effects\n\nThey have a page of their own: [effects.md](effects.md).\n")
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def about(record: type) -> str:
    """A record's docstring as Markdown: its Args become a list."""
    text, _, args = (record.__doc__ or "").partition("    Args:\n")
    lines = [re.sub(r"^`\[[a-z.]+\]`: ", "", line.strip()) for line in text.strip().splitlines()]
    for line in args.rstrip().splitlines():
        start = re.match(r" {8}([a-z_]\w*(?:, \w+)*): (.*)", line)
        names = ", ".join(f"`{n}`" for n in start[1].split(", ")) if start else ""
        lines.append(f"- {names}: {start[2]}" if start else "  " + line.strip())
    return "\n".join(lines).strip() + "\n\n"


def rows(record: type) -> str:
    """A record's fields as a Markdown table."""
    fields = dataclasses.fields(record)
    if not fields:
        return "No parameters.\n"
    lines = ["| key | default | range | unit |", "|---|---|---|---|"]
    for field in fields:
        meta = field.metadata
        span = ", ".join(meta["choices"]) if meta["choices"] else _range(meta["lo"], meta["hi"])
        if field.default_factory is not dataclasses.MISSING:
            default, span = "", "a table"
        else:
            default = "*required*" if field.default is dataclasses.MISSING else f"`{_value(field.default)}`"
        lines.append(f"| `{field.name}` | {default} | {span} | {meta['unit']} |")
    return "\n".join(lines) + "\n"


def _range(lo: float, hi: float) -> str:
    return "" if lo == -math.inf and hi == math.inf else f"{lo:.10g} to {hi:.10g}"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return str(list(value)) if isinstance(value, tuple) else f"{value:g}"


if __name__ == "__main__":
    print(page(), end="")
