"""The page of scene files is the one the records make, and shows every key."""

from pathlib import Path

from spikerig.rigctl.sim.page import page

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_page_is_made_from_the_records() -> None:
    text = (DOCS / "scenes.md").read_text(encoding="utf-8")
    assert text == page(), "python -m spikerig.rigctl.sim.page > docs/scenes.md"
    for words in ("`path_px`", "`threshold_e`", "`test_every`", "| `radius` | *required* |", "Siemens"):
        assert words in text
