"""Each instruction set that this machine has, and the team size put back."""

from collections.abc import Iterator

import pytest

from spikerig import _native


@pytest.fixture(params=_native.isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run with the kernels of one instruction set; the one before is set again."""
    before = _native.isa()
    _native.set_isa(request.param)
    yield request.param
    _native.set_isa(before)


@pytest.fixture
def threads() -> Iterator[None]:
    """Let a test change the kernels' team size; the one before is set again."""
    before = _native.threads()
    yield
    _native.set_threads(before)
