"""Pictures of unknown cameras in a folder: the known answer, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spikerig.dataset import cli
from spikerig.dataset.images import write_image


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict]:
    code = cli.run(["calib", "poses", *words, "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.real
def test_sacre_coeur(shared_data: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten photos by ten cameras, at 800 px: all in one model, 0.298 px when COLMAP is asked directly.

    Residuals are in pixels of the pictures as they are, so they are made smaller beforehand.
    """
    import cv2

    for path in (shared_data("sfm/sacre_coeur") / "mapping").glob("*.jpg"):
        whole = cv2.imread(str(path))
        assert whole is not None
        scale = 800 / max(whole.shape[:2])
        small = cv2.resize(whole, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / path.name), small)
    code, told = run(capsys, str(tmp_path))
    assert code == 0, told
    assert told["registered"] == told["images"] == 10
    assert told["models"][0] == 10
    assert told["error_px"] == pytest.approx(0.298, abs=0.025)
    assert told["points"] > 800


def test_folders_that_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = run(capsys, str(tmp_path))
    assert (code, "no pictures" in told["error"]["what"]) == (2, True)
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png", "b.jpg"):
        (tmp_path / name).write_bytes(b"")
    code, told = run(capsys, str(tmp_path))
    assert (code, told["error"]["value"]) == (2, "b")
    for path in tmp_path.iterdir():
        path.unlink()
    for name in "abcd":  # four pictures of four different things
        write_image(tmp_path / f"{name}.png", rng.integers(0, 255, (60, 80, 3)).astype(np.uint8))
    code, told = run(capsys, str(tmp_path))
    assert code == 4
    assert "0 of 4" in told["error"]["value"]
