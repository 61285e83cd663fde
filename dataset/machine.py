"""Where a number was measured: machine, versions, commit. Goes beside every figure the tool writes."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any


def describe() -> dict[str, Any]:
    """CPU, cores, load, kernels in use, versions and commit, as a JSON-ready record."""
    from spikerig import _native

    return {
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": [round(x, 2) for x in os.getloadavg()],
        "isa": _native.isa(),
        "threads": _native.threads(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {d: metadata.version(d) for d in ("spikerig", "numpy", "torch", "h5py") if _known(d)},
        "commit": commit(),
    }


def cpu_model() -> str:
    """The CPU's name as the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def commit() -> str | None:
    """The commit of the spikerig checkout we stand in, `+` appended where files differ from it; None elsewhere."""
    try:
        top = Path(_git("rev-parse", "--show-toplevel"))
        if 'name = "spikerig"' not in (top / "pyproject.toml").read_text(encoding="utf-8"):
            return None
        return _git("rev-parse", "--short=12", "HEAD") + ("+" if _git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def command() -> str:
    """The command line of this process as a user would type it."""
    return shlex.join(["spikerig", *sys.argv[1:]])


def caption(machine: dict[str, Any]) -> str:
    """One line for under a table: CPU, cores, kernels, commit."""
    return (
        f"{machine['cpu']}, {machine['cores']} cores, kernels {machine['isa']} on {machine['threads']} threads, "
        f"commit {machine['commit'] or 'unknown'}"
    )


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


def _known(dist: str) -> bool:
    try:
        metadata.version(dist)
    except metadata.PackageNotFoundError:
        return False
    return True
