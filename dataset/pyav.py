"""PyAV, imported when a video is first touched."""

from __future__ import annotations

from types import ModuleType

from spikerig.dataset.errors import HostError


def pyav() -> ModuleType:
    """The module `av`.

    Raises:
        HostError: the extra that brings it was left out.
    """
    try:
        import av
    except ImportError as error:
        raise HostError(
            "video files need PyAV, which is not installed", cause="the extra 'video' was left out",
            next='pip install "spikerig[video]"',
        ) from error  # fmt: skip
    return av
