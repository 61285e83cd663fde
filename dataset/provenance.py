"""Where a result comes from: the content it was made of, and the versions of what made it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikerig.dataset.store_read import SceneFile


def origin_of(scene: SceneFile, *packages: str, files: Mapping[str, Path | None] | None = None) -> dict[str, Any]:
    """A record of what a result was made of and with, JSON-ready.

    Args:
        scene: that it was made from.
        packages: whose versions matter, beside spikerig and numpy.
        files: others that went into it, by what they are; None ones are left out.

    Returns:
        "source": name and SHA-256 of the scene's content (as stored in it); "files": name and SHA-256 of their bytes;
        "versions" by package.
    """
    given = {what: path for what, path in (files or {}).items() if path is not None}
    return {
        "source": {"name": scene.path.name, "sha256": scene.sha256},
        "files": {what: {"name": path.name, "sha256": file_sha256(path)} for what, path in given.items()},
        "versions": {p: v for p in ("spikerig", "numpy", *packages) if (v := _version(p))},
    }


def file_sha256(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
