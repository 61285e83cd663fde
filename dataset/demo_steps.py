"""The demo as data: command lines, in order."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

# The honest rows: blurry single pose, blurry with true sub-poses, the paper's loss, ours, and the sharp upper bound.
METHODS = {
    "demo": ("plain", "average", "spikenerf", "spike-ratio", "oracle"),
    "chroma": ("plain", "average", "spikenerf", "spike-hybrid", "oracle"),
}


@dataclass(frozen=True, slots=True)
class Step:
    """One command line of the demo: a key, its words after `spikerig`, and a line for people."""

    key: str
    words: tuple[str, ...]
    says: str


def steps(out: Path, seconds: dict[str, float], seed: int, train_steps: int = 0) -> list[Step]:
    """The demo as data: every command line in order.

    Args:
        out: folder of the run.
        seconds: scene name -> training seconds of each method; scenes run in this order.
        seed: of the simulation and of training.
        train_steps: of each method, instead of seconds; 0 goes by seconds.
    """
    listed: list[Step] = []
    for scene, budget in seconds.items():
        file = str(out / f"{scene}.h5")
        capture = ("sim", "capture", scene, "-o", file, "--seed", str(seed), "--force", "--json")
        listed.append(Step(f"{scene}-capture", capture, f"simulate the '{scene}' capture"))
        for method in METHODS[scene]:
            listed += learn(out, scene, method, (budget, train_steps), seed)
    return listed


def learn(
    out: Path,
    scene: str,
    method: str,
    length: tuple[float, int],
    seed: int,
    *,
    file: str = "",
    exam: str = "",
    points: str = "",
) -> list[Step]:
    """Train a method and score it.

    Args:
        out: folder of the run.
        scene: what the run belongs to.
        method: of training.
        length: (seconds, steps); steps where not 0.
        seed: of training.
        file, exam, points: scenes in `out` to train on, to be scored on, to take initial points from; else `scene`.
    """

    def at(name: str) -> str:
        return str(out / f"{name}.h5")

    run, (seconds, count) = str(out / f"{scene}-{method}"), length
    long = ("--steps", str(count)) if count else ("--seconds", f"{seconds:g}")
    fit = ("train", "fit", at(file or scene), "--field", "splat", "--method", method, "--preset", "draft", *long)
    fit += ("--seed", str(seed), "-o", run, *(("--score-on", at(exam)) if exam else ()))
    fit += (*(("--points-of", at(points)) if points else ()), "--force", "--json")
    score = ("train", "score", run, *((at(exam),) if exam else ()), "--pictures", str(Path(run) / "pictures"))
    told = f"{count} steps" if count else f"{seconds:g} s"
    return [
        Step(f"{scene}-{method}-fit", fit, f"train '{method}' on '{scene}' for {told}"),
        Step(f"{scene}-{method}-score", (*score, "--force", "--json"), f"score '{method}' on sharp held-out views"),
    ]
