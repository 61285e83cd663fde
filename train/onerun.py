"""One training run in a process of its own, so that its memory and CPU seconds are its own: `python -m` with a job."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import RigError, UsageError

MODULE = "spikerig.train.onerun"


def run_apart(scene: Path, config: dict[str, Any]) -> dict[str, Any]:
    """Train in a child process.

    Args:
        scene: a scene file with sharp held-out views.
        config: `FitConfig.as_json`.

    Returns:
        psnr (held-out, dB), train_seconds, cpu_seconds (of preparing, training and scoring, not of starting Python),
        peak_bytes (of the whole process, torch's libraries among them), renders, steps.

    Raises:
        UsageError: the run failed; says what the child said.
    """
    with tempfile.TemporaryDirectory(prefix="spikerig-run-") as folder:
        job, made = Path(folder) / "job.json", Path(folder) / "made.json"
        job.write_text(json.dumps({"scene": str(scene), "config": config, "out": str(made)}), encoding="utf-8")
        done = subprocess.run([sys.executable, "-m", MODULE, str(job)], capture_output=True, text=True, check=False)
        if done.returncode or not made.exists():
            raise UsageError(
                "a run of this sweep failed",
                value=f"{config['method']} on {config['field']}, exit {done.returncode}",
                cause="; ".join(done.stderr.strip().splitlines()[-3:]),
            )
        return json.loads(made.read_text(encoding="utf-8"))


def main(job: Path) -> None:
    """What the child does."""
    from spikerig.train.config import from_json
    from spikerig.train.run import run_fit

    asked = json.loads(job.read_text(encoding="utf-8"))
    begin = time.process_time()
    done = run_fit(Path(asked["scene"]), from_json(asked["config"]), job.parent / "run", eval_every=0)
    cpu = time.process_time() - begin
    if done["psnr"] is None:
        raise UsageError(
            "this scene has no sharp held-out views to score", value=asked["scene"], next="spikerig sim capture"
        )
    made = {
        "psnr": done["psnr"],
        "train_seconds": done["train_seconds"],
        "cpu_seconds": cpu,
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "renders": done.get("renders"),
        "steps": done["steps"],
    }
    beside = Path(asked["out"] + ".part")
    beside.write_text(json.dumps(made), encoding="utf-8")
    os.replace(beside, asked["out"])


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except RigError as error:
        sys.exit(str(error))
