"""The table of the rig's errors is true: every test that it names exists, and the page shows the table."""

import ast
from functools import cache
from pathlib import Path

import pytest
import rig_errors

TESTS = Path(__file__).resolve().parents[1]


@cache
def functions(name: str) -> set[str]:
    tree = ast.parse((TESTS / name).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("part", rig_errors.PARTS)
def test_every_row_names_tests_that_exist(part: str) -> None:
    for row in rig_errors.PARTS[part]:
        assert row.tests, row.error
        for test in row.tests:
            name, _, function = test.partition("::")
            assert function in functions(name), row.error


def test_the_page_is_the_table() -> None:
    page = TESTS.parent / "docs" / "hardware" / "errors.md"
    assert page.read_text(encoding="utf-8") == rig_errors.page(), "python tests/rig_errors.py > docs/hardware/errors.md"
