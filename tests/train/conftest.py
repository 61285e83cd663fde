"""A small simulated scene for the training tests."""

import tomllib
from importlib.resources import files
from pathlib import Path

import pytest

from spikerig import _native
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import read_scene


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's scene, 6 training views and 1 held out of 64x40 pixels, 600 points, spikes and events."""
    table = tomllib.loads(files("spikerig.rigctl.sim").joinpath("scenes/demo.toml").read_text(encoding="utf-8"))
    table["name"] = "tiny"
    table["camera"] |= {"width": 64, "height": 40}
    table["orbit"] |= {"views": 7, "test_every": 7}
    table["events"] = {}
    table["points"] |= {"count": 600}
    path = tmp_path_factory.mktemp("scene") / "tiny.h5"
    capture(read_scene(table), path)
    return path


@pytest.fixture
def threads():
    """Set the kernels' team size; restored afterwards."""
    before = _native.threads()
    yield _native.set_threads
    _native.set_threads(before)
