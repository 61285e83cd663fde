"""Everything that can go wrong, as one tree.

    RigError                    base: never raised itself
    |-- UsageError        2     the command or call is wrong: an option, a combination, a name
    |-- DeviceError       3     a camera, a box or a link misbehaves
    |-- DataError         4     a file is damaged, foreign, or not what it says
    |   `-- RefusedError  4     a result is too poor to keep (calibration, poses)
    |-- NumericsError     5     a value that must be finite is not
    `-- HostError         6     this machine lacks something: an extra, disk space, a permission

Exit codes beside the names; 1 means "findings", 70 is our bug, 130 an interrupt.
"""

from __future__ import annotations

from typing import Any


class RigError(Exception):
    """A fault told so that the reader can act: what, its value, what was expected, the cause, the next command.

    Args:
        what: one sentence, what is wrong.
        value: the offending value, as found.
        expected: what would have been right.
        cause: the likeliest cause.
        next: the command or step to do next.
    """

    exit_code = 70

    def __init__(self, what: str, *, value: Any = None, expected: str = "", cause: str = "", next: str = "") -> None:
        self.what, self.value, self.expected, self.cause, self.next = what, value, expected, cause, next
        super().__init__(what)

    def __str__(self) -> str:
        """The whole message, a line a part; parts not given are left out."""
        lines = [self.what]
        if self.value is not None:
            lines.append(f"  found:    {self.value!s}")
        for label, text in (("expected", self.expected), ("cause", self.cause), ("next", self.next)):
            if text:
                lines.append(f"  {label + ':':<9} {text}")
        return "\n".join(lines)

    def as_json(self) -> dict[str, Any]:
        """The same as a JSON-ready record."""
        return {
            "type": type(self).__name__,
            "exit_code": self.exit_code,
            "what": self.what,
            "value": None if self.value is None else str(self.value),
            "expected": self.expected or None,
            "cause": self.cause or None,
            "next": self.next or None,
        }


class UsageError(RigError):
    """The command or call is wrong."""

    exit_code = 2


class DeviceError(RigError):
    """A camera, a box or a link misbehaves."""

    exit_code = 3


class DataError(RigError):
    """A file is damaged, foreign, or not what it says it is."""

    exit_code = 4


class RefusedError(DataError):
    """A result is too poor to be kept."""


class NumericsError(RigError):
    """A value that must be finite is not."""

    exit_code = 5


class HostError(RigError):
    """This machine lacks something the command needs."""

    exit_code = 6
