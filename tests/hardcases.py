"""The table of hard cases: which hard input meets which function, and what must come out.

Each part keeps its own rows in `hard_<part>.py` as `ROWS = [(case, function, expectation, test)]`, `test` naming the
test that holds it. This file gathers them and makes the page: `python tests/hardcases.py > docs/hardcases.md`.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import NamedTuple


class Row(NamedTuple):
    """One hard input, the function that meets it, what must come out, and the test (`file::function`) that says so."""

    case: str
    function: str
    expectation: str
    test: str


def parts() -> list[str]:
    """Names of the parts that have rows, sorted."""
    return sorted(p.stem.removeprefix("hard_") for p in Path(__file__).parent.glob("hard_*.py"))


def rows(part: str) -> list[Row]:
    """The rows of one part."""
    return [Row(*row) for row in importlib.import_module(f"hard_{part}").ROWS]


def page() -> str:
    """docs/hardcases.md."""
    lines = [
        "# Hard cases",
        "",
        "Every function that can meet a hard input meets it in a test: a finite value, a finite gradient, agreement "
        "with the float64 or integer oracle, the known limit. Made by `python tests/hardcases.py > docs/hardcases.md`.",
    ]
    for part in parts():
        lines += [
            "",
            f"## {part.capitalize()}",
            "",
            "| hard case | function | what must come out | test |",
            "|---|---|---|---|",
        ]
        lines += [f"| {r.case} | `{r.function}` | {r.expectation} | `{r.test}` |" for r in rows(part)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    import sys

    sys.path.insert(0, str(Path(__file__).parent))
    print(page(), end="")
