"""The table of hard cases is true: every row names a test that exists, and the page shows the table."""

import ast
from pathlib import Path

import hardcases
import pytest

TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("part", hardcases.parts())
def test_every_row_names_a_test_that_exists(part: str) -> None:
    rows = hardcases.rows(part)
    assert rows
    for row in rows:
        name, _, function = row.test.partition("::")
        tree = ast.parse((TESTS / name).read_text(encoding="utf-8"))
        functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        assert function in functions, row


def test_the_page_is_the_table() -> None:
    page = TESTS.parent / "docs" / "hardcases.md"
    assert page.read_text(encoding="utf-8") == hardcases.page(), "python tests/hardcases.py > docs/hardcases.md"
