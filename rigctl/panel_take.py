"""The LED panel read in a whole take: sights of its spikes and clips, which tie both cameras to the panel's time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from spikerig.calib.panel_read import Spot
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.marks import MarkLog, Sight, read_marks
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.panel import Led, Panel
from spikerig.dataset.rawtake import open_take
from spikerig.rigctl.ingest_sights import InView, found_in, panel_in_view, sights
from spikerig.rigctl.ingest_slips import mended
from spikerig.rigctl.ingest_times import Framing
from spikerig.rigctl.view_parts import without

SCHEMA, FIND = "spikerig.panel/1", "find"


def read_spots(path: str | Path) -> InView:
    """A file of spots: {"schema": "spikerig.panel/1", "panel": {step_ns, bits, slow, leds}, "spike": [[led, x, y, r]],
    "rgb": [...]}; `leds` ([[bit, inverted, x_mm, y_mm]]) may be left out for the usual two rows. In place of an arm's
    spots "find": by their blinking, at the first viewpoint where they are seen.

    Raises:
        UsageError: there is no such file.
        DataError: it is something else.
    """
    try:
        told = json.loads(Path(path).read_text(encoding="utf-8"))
        if told["schema"] != SCHEMA:
            raise ValueError(f"schema {told['schema']!r}")
        own = dict(told["panel"])
        leds = tuple(Led(int(b), bool(i), float(x), float(y)) for b, i, x, y in own.pop("leds", ()))
        panel = Panel(**{k: int(v) for k, v in own.items()}, leds=leds)
        wanted = {k: told[k] == FIND for k in ("spike", "rgb")}
        spots = {
            k: () if wanted[k] else tuple(Spot(int(n), float(x), float(y), float(r)) for n, x, y, r in told[k])
            for k in wanted
        }
        numbers = [s.led for row in spots.values() for s in row]
        if not any(wanted.values()) and (not numbers or min(numbers) < 0 or max(numbers) >= len(panel.leds)):
            raise ValueError("a spot names an LED that the panel does not have, or there are none")
        return InView(panel, spots["spike"], spots["rgb"], tuple(k for k in wanted if wanted[k]))
    except OSError as error:
        raise UsageError("the file of spots cannot be read", value=f"{path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, UsageError) as error:
        raise DataError("not a file of the panel's spots", value=path, cause=str(error), expected=SCHEMA) from error


def read_panel(folder: str | Path, view: InView | None = None, *, force: bool = False) -> dict[str, Any]:
    """Read the panel in every kept viewpoint of a take and add the sights to its marks.

    Args:
        folder: of the take, not being recorded.
        view: the panel and its spots; None: as the take's plan says.
        force: sights that are there already are replaced.

    Returns:
        How many sights each camera gave, and what could not be read.

    Raises:
        UsageError: sights are there and `force` is not given; or nobody says where the panel is.
        DataError: nothing in the take shows the panel.

    Edges:
        Small losses that only the framing tells are mended as `data ingest` does: sights are on the camera's own time.
    """
    take = open_take(folder)
    view = view or panel_in_view(take.plan)
    if view is None:
        raise UsageError("where the panel is in the pictures is not known", value=take.folder,
                         expected="[panel] in the take's plan, or a file of spots")  # fmt: skip
    path = take.folder / "marks.jsonl"
    marks = list(read_marks(path)) if path.exists() else []
    old = [m for m in marks if isinstance(m, Sight)]
    if old and not force:
        raise UsageError("this take's panel was read already", value=f"{len(old)} sights", next="--force reads anew")
    marks = without(marks, Sight)
    views = [v for v in take.views() if v.kept]
    wire, views = mended(take, views)
    framing = Framing(wire, [s for v in views for s in v.spikes], view.pairs)
    view = found_in(take, views, view, wire, framing)
    seen, missing = sights(take, views, view, marks, wire, framing)
    if not seen:
        raise DataError("nothing in this take shows the panel", value=take.folder, cause="; ".join(missing)[:500])
    with whole_file(path, force=True) as part:
        log = MarkLog(part)
        log.add([*marks, *seen])
        log.close()
    return {
        "spike": sum(s.clock == "spike" for s in seen), "rgb": sum(s.clock == "rgb" for s in seen),
        "trouble": [f"{where}: {why}" for where, why in missing.items()],
    }  # fmt: skip
