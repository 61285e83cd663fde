"""Views on a shelf: they come back as they were, and foreign ones are refused."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small

from spikerig.dataset.errors import DataError, UsageError
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.shelf import Shelf, dumps, loads


def test_a_view_comes_back_as_it_was() -> None:
    taken = take_view(small(), 0)
    back = loads(dumps(taken), "here")
    assert dumps(back) == dumps(taken)
    assert np.array_equal(back.view.spikes.bits, taken.view.spikes.bits)  # type: ignore[union-attr]
    assert np.array_equal(back.light, taken.light)
    assert back.at_ns == taken.at_ns
    assert back.blur_db == taken.blur_db
    sharp = loads(dumps(take_view(small(), 2)), "here")
    assert sharp.view.spikes is None
    assert np.isnan(sharp.blur_db)


def _npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


def test_foreign_views_are_refused(tmp_path: Path) -> None:
    good = dumps(take_view(small(), 0))

    def tree(value: Any) -> bytes:
        return _npz(tree=np.frombuffer(json.dumps(value).encode(), np.uint8))

    for data in (
        b"",
        good[:200],
        good[: len(good) // 2],
        _npz(tree=np.array([Evil(tmp_path / "opened")], dtype=object)),
        _npz(a0=np.zeros(3)),
        tree({"record": "os.system"}),
        tree({"record": "Pose", "cam_from_world": {"array": "a0"}}),
        tree([1, 2]),
        tree({"float": "x"}),
    ):
        with pytest.raises(DataError, match="damaged"):
            loads(data, "x.npz")
    assert not (tmp_path / "opened").exists()


def test_a_shelf_keeps_to_its_settings(tmp_path: Path) -> None:
    folder = tmp_path / "views"
    one = Shelf(folder, {"seed": 1, "a": (1, 2)})
    one.path(3).write_bytes(b"x")
    assert Shelf(folder, {"seed": 1, "a": [1, 2]}).missing(4) == [0, 1, 2]
    with pytest.raises(UsageError) as caught:
        Shelf(folder, {"seed": 2, "a": [1, 2]})
    assert "seed: 1 there, 2 here" in str(caught.value)
    assert Shelf(folder, {"seed": 2}, force=True).missing(4) == [0, 1, 2, 3]
    one.clear()
    assert not folder.exists()
