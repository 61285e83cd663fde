"""Fixtures for every test."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

DATA = Path(os.environ.get("SPIKERIG_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """Path of a third-party file in the shared data folder; skips, by name and with the reason, where it is absent."""

    def find(name: str) -> Path:
        path = DATA / name
        if not path.exists():
            pytest.skip(f"third-party data '{name}' is not here: set SPIKERIG_DATA (looked in {DATA})")
        return path

    return find
