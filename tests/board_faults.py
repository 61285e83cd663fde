"""How each refusal of `calib board` is provoked: for the test, and for the table of docs/calibration.md, which
`PYTHONPATH=tests python tests/board_faults.py` prints."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import board_pictures as bp
import numpy as np
from board_shots import shoot

SEED = 31


class Case(NamedTuple):
    """A fault: the code it ends in, what was done, in words, the pictures, and options beside."""

    code: str
    how: str
    shots: Callable[[Path], object]
    options: tuple[str, ...] = ()


def swapped(folder: Path) -> None:
    """Two RGB pictures under each other's name."""
    shoot(folder, bp.poses(6, SEED))
    a, b, spare = (folder / f"b/cam_b_{k}.png" for k in ("01", "04", "spare"))
    a.rename(spare)
    b.rename(a)
    spare.rename(b)


def copied(folder: Path) -> None:
    """A pair that is there twice."""
    shoot(folder, bp.poses(5, SEED))
    for name in "ab":
        (folder / f"{name}/cam_{name}_07.png").write_bytes((folder / f"{name}/cam_{name}_01.png").read_bytes())


def moved(folder: Path) -> None:
    """The board some 20 mm elsewhere when the RGB picture was shot."""
    poses = bp.poses(4, SEED)
    late = poses.copy()
    late[:, :, 3] += np.random.default_rng(5).normal(size=(4, 3)) * 20
    shoot(folder, poses, late=late)


def mirrored(folder: Path) -> None:
    """The RGB arm looks into the splitter's mirror."""
    from spikerig.dataset.images import read_image, write_image

    shoot(folder, bp.poses(4, SEED))
    for path in sorted((folder / "b").iterdir()):
        write_image(path, np.ascontiguousarray(read_image(path)[:, ::-1]), force=True)


CASES = (
    Case("too-few-views", "three pairs", lambda f: shoot(f, bp.poses(3, SEED))),
    Case("flat-boards", "four pairs of boards tilted by at most 1 degree", lambda f: shoot(f, bp.poses(4, SEED, 1.0))),
    Case("not-one-rig", "the board moved some 20 mm between the two pictures of each pair", moved),
    Case("not-one-rig", "an arm that is mirrored, and `--mirror none`", mirrored, ("--mirror", "none")),
    Case("odd-pairs", "two RGB pictures of six under each other's name", swapped),
    Case("wrong-pattern", "`--pattern 10x7` for a board of 9x6", lambda f: shoot(f, bp.poses(5, SEED)),
         ("--pattern", "10x7")),
    Case("duplicates", "a pair that is there twice", copied),
    Case("bad-corners", "a board that curls, its edges 6 mm out of plane",
         lambda f: shoot(f, bp.poses(4, SEED), curl=1e-3)),
    Case("loose-crop", "a board that curls, its edges 2 mm out of plane",
         lambda f: shoot(f, bp.poses(5, SEED), curl=3e-4)),
)  # fmt: skip


def words(folder: Path, case: Case) -> list[str]:
    """The command line."""
    pattern = [] if "--pattern" in case.options else ["--pattern", "9x6"]
    return ["calib", "board", str(folder / "a"), str(folder / "b"), *pattern, "--square-mm", "16", *case.options,
            "-o", str(folder / "calib.json"), "--json"]  # fmt: skip


def main() -> None:
    """Run each by its command line and print a row of the table."""
    import contextlib
    import io
    import json
    import tempfile

    from spikerig.dataset import cli

    print("| code | how it was provoked | words |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for k, case in enumerate(CASES):
            here = Path(folder) / str(k)
            case.shots(here)
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()):
                code = cli.run(words(here, case))
            told = json.loads(out.getvalue())
            text = dict(zip(told["reason_codes"], told["reasons"], strict=True)).get(case.code, "NOT SEEN")
            also = ", ".join(f"`{c}`" for c in sorted(set(told["reason_codes"]) - {case.code}))
            print(f"| `{case.code}` | {case.how} | {text}{f' (and {also})' if also else ''} |")
            if code != 4 or not told["reasons"]:
                raise SystemExit(f"{case}: exit {code}")


if __name__ == "__main__":
    main()
