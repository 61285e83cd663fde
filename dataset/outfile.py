"""Files that appear whole or not at all, and never replace another unasked."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spikerig.dataset.errors import HostError, UsageError


def refuse_existing(path: Path, force: bool) -> None:
    """Raise a UsageError where `path` exists and `force` is not given: call it before the work begins."""
    if path.exists() and not force:
        raise UsageError("the file exists already", value=path, next="give --force to replace it")


@contextmanager
def whole_file(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """A name beside `path` to write to; it becomes `path` when the block ends well, and is gone when it does not.

    Raises:
        UsageError: `path` exists and force is not given, or its folder does not exist.
        HostError: the system refuses (disk full, no permission).
    """
    target = Path(path)
    refuse_existing(target, force)
    if not target.parent.is_dir():
        raise UsageError("there is no such folder", value=target.parent, next=f"mkdir -p {target.parent}")
    part = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    try:
        yield part
        os.replace(part, target)
    except OSError as error:
        raise HostError("the file cannot be written", value=f"{target}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
