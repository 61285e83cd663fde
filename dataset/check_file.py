"""The check of the file itself: schema, checksums and records, by `store.verify_scene`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from spikerig.dataset.check import Check, Fault, check
from spikerig.dataset.check_look import SceneLook


@check(
    "structure",
    "error",
    "the file breaks its schema, a checksum differs, numbers are not finite (NaN poses), or a record cannot be "
    "made of what is stored; unfinished files; what the schema does not know is a note",
    "get the file again from its source, or write it again",
)
def file_is_whole(scene: SceneLook, _: Mapping[str, object]) -> Iterator[Fault]:
    """All that `spikerig data verify` finds."""
    from spikerig.dataset.store import verify_scene

    for found in verify_scene(scene.file.path):
        yield Fault(found.where, f"{found.check}: {found.message}", found.importance)  # type: ignore[arg-type]


FILE: tuple[Check, ...] = (file_is_whole,)
