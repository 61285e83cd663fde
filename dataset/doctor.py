"""`spikerig doctor`: what matters about this machine and installation; every problem at once with its fix."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import tempfile
import time
from importlib import metadata, util
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.terminal import emit, note

# distribution -> (module, what it is for); only looked up, never imported, so that a broken one cannot end the check
PACKAGES = {
    "numpy": ("numpy", "everything"),
    "h5py": ("h5py", "scene files"),
    "OpenEXR": ("OpenEXR", "linear pictures"),
    "opencv-contrib-python-headless": ("cv2", "PNG, calibration"),
    "pycolmap": ("pycolmap", "poses"),
    "pyusb": ("usb", "the spike camera"),
    "libusb-package": ("libusb_package", "the spike camera"),
    "pyserial": ("serial", "the clock box"),
    "typer": ("typer", "the command line"),
    "torch": ("torch", "training"),
    "safetensors": ("safetensors", "checkpoints"),
}
EXTRAS = {"matplotlib": ("matplotlib", "plot"), "gsplat": ("gsplat", "cuda")}
WANTED_FREE = 5 * 2**30
WANTED_WRITE = 100 * 2**20  # bytes a second: a packaged 400x250 view every tenth of a second


def doctor(
    folder: Annotated[Path, typer.Option(help="Where data will be written: its disk is measured.")] = Path("."),
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Check this machine and installation; every problem at once, each with its fix.

    Exit codes: 0 all well, 1 problems found.
    """
    report = examine(folder)
    if as_json:
        emit("spikerig.doctor/1", report)
    else:
        _print(report)
    if report["problems"]:
        raise typer.Exit(1)


def examine(folder: Path) -> dict[str, Any]:
    """The whole report as a JSON-ready record; `problems` is a list of {what, fix}."""
    problems: list[dict[str, str]] = []
    report = {
        "python": {"version": platform.python_version(), "executable": sys.executable},
        "platform": platform.platform(),
        "spikerig": _package("spikerig", "spikerig.dataset", problems, "reinstall: make install"),
        "packages": {
            dist: _package(dist, module, problems, f"pip install {dist}    (needed for {what})")
            for dist, (module, what) in PACKAGES.items()
        },
        "extras": {
            dist: _package(dist, module, None, "") | {"extra": extra} for dist, (module, extra) in EXTRAS.items()
        },
        "kernels": _kernels(problems),
        "gpu": _gpu(),
        "libusb": _libusb(problems),
        "disk": _disk(folder, problems),
        "problems": problems,
    }
    _shadowed(problems)
    return report


def _package(dist: str, module: str, problems: list[dict[str, str]] | None, fix: str) -> dict[str, Any]:
    try:
        version = metadata.version(dist)
        spec = util.find_spec(module)
    except (metadata.PackageNotFoundError, ModuleNotFoundError):
        version, spec = None, None
    if spec is None and problems is not None:
        problems.append({"what": f"{dist} is not installed", "fix": fix})
    where = None if spec is None else spec.origin or next(iter(spec.submodule_search_locations or []), None)
    return {"version": version, "loaded_from": where}


def _kernels(problems: list[dict[str, str]]) -> dict[str, Any]:
    try:
        from spikerig import _native
    except ImportError as error:
        problems.append({"what": f"the native kernels do not load: {error}", "fix": "reinstall: make install"})
        return {"isa": None, "usable": [], "threads": None}
    except ValueError as error:
        problems.append({"what": f"SPIKERIG_ISA is wrong: {error}", "fix": "unset SPIKERIG_ISA"})
        return {"isa": None, "usable": [], "threads": None}
    try:
        used = _native.isa()
    except ValueError as error:
        problems.append(
            {"what": f"SPIKERIG_ISA={os.environ.get('SPIKERIG_ISA')}: {error}", "fix": "unset SPIKERIG_ISA"}
        )
        used = None
    return {"isa": used, "usable": _native.isas(), "threads": _native.threads(), "loaded_from": _native.__file__}


def _gpu() -> dict[str, Any]:
    """What the driver's files say; torch is not imported for it (seconds, and it may be the broken part)."""
    cards = Path("/proc/driver/nvidia/gpus")
    names = []
    if cards.is_dir():
        for card in sorted(cards.iterdir()):
            text = (card / "information").read_text(errors="replace") if (card / "information").exists() else ""
            names += [line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("Model")]
    torch_build = None
    with contextlib.suppress(metadata.PackageNotFoundError):
        torch_build = metadata.version("torch")
    return {"nvidia": names, "torch": torch_build, "note": None if names else "none found; the CPU does everything"}


def _libusb(problems: list[dict[str, str]]) -> dict[str, Any]:
    try:
        import libusb_package  # type: ignore[import-untyped]

        path = libusb_package.get_library_path()
    except ImportError:
        return {"library": None}
    if path is None:
        problems.append({"what": "the libusb-package wheel holds no library", "fix": "pip install -U libusb-package"})
    return {"library": None if path is None else str(path)}


def _disk(folder: Path, problems: list[dict[str, str]]) -> dict[str, Any]:
    try:
        free = shutil.disk_usage(folder).free
        speed = write_speed(folder) if free > 2**28 else None
    except OSError as error:
        problems.append(
            {"what": f"cannot write in {folder}: {error.strerror}", "fix": "give --folder DIR you may write"}
        )
        return {"folder": str(folder), "free_bytes": None, "write_bytes_s": None}
    if free < WANTED_FREE:
        problems.append({
            "what": f"only {free / 2**30:.1f} GiB free in {folder.resolve()}",
            "fix": "free some space, or give --folder DIR on another disk",
        })  # fmt: skip
    if speed is not None and speed < WANTED_WRITE:
        problems.append({
            "what": f"{folder.resolve()} writes {speed / 2**20:.0f} MiB/s, under {WANTED_WRITE / 2**20:.0f}",
            "fix": "use a local disk, not a network share",
        })  # fmt: skip
    return {"folder": str(folder.resolve()), "free_bytes": free, "write_bytes_s": speed}


def write_speed(folder: Path, size: int = 64 * 2**20) -> float:
    """Bytes a second written and fsynced to a temporary file in `folder`; the file is removed."""
    block = os.urandom(2**20)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".spikerig-disk-") as file:
        start = time.perf_counter()
        for _ in range(size // len(block)):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
        return size / (time.perf_counter() - start)


def _shadowed(problems: list[dict[str, str]]) -> None:
    """More than one OpenCV wheel writes the same cv2 folder: whichever came last wins, silently."""
    found = [d for d in ("opencv-python", "opencv-python-headless", "opencv-contrib-python") if _installed(d)]
    if found:
        problems.append({
            "what": f"another OpenCV wheel overwrites ours: {', '.join(found)}",
            "fix": f"pip uninstall -y {' '.join(found)}; pip install --force-reinstall opencv-contrib-python-headless",
        })  # fmt: skip


def _installed(dist: str) -> bool:
    try:
        metadata.version(dist)
    except metadata.PackageNotFoundError:
        return False
    return True


def _print(report: dict[str, Any]) -> None:
    rows = [("python", report["python"]["version"], report["python"]["executable"])]
    rows += [("spikerig", report["spikerig"]["version"], report["spikerig"]["loaded_from"])]
    rows += [(name, p["version"], p["loaded_from"]) for name, p in report["packages"].items()]
    rows += [
        (name, p["version"] or "not installed", p["loaded_from"] or f"optional: extra '{p['extra']}'")
        for name, p in report["extras"].items()
    ]
    width = max(len(name) for name, _, _ in rows)
    for name, version, where in rows:
        note(f"{name:<{width}}  {version or 'MISSING':<16} {where or ''}")
    kernels, disk = report["kernels"], report["disk"]
    note(f"{'kernels':<{width}}  {kernels['isa']} of {', '.join(kernels['usable'])}; {kernels['threads']} threads")
    note(f"{'gpu':<{width}}  {', '.join(report['gpu']['nvidia']) or report['gpu']['note']}")
    note(f"{'libusb':<{width}}  {report['libusb']['library'] or 'MISSING'}")
    if disk["free_bytes"] is not None:
        speed = "not measured" if disk["write_bytes_s"] is None else f"{disk['write_bytes_s'] / 2**20:.0f} MiB/s"
        note(f"{'disk':<{width}}  {disk['free_bytes'] / 2**30:.0f} GiB free, writes {speed}  {disk['folder']}")
    if not report["problems"]:
        note("all well")
    for k, problem in enumerate(report["problems"], 1):
        note(f"problem {k}: {problem['what']}\n  fix: {problem['fix']}")
