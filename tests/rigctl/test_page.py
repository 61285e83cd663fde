"""The pages of scene files and of effects are those the records make, and show every key."""

from pathlib import Path

from spikerig.rigctl.sim.effects import EFFECTS
from spikerig.rigctl.sim.effects_page import page as effects_page
from spikerig.rigctl.sim.page import page

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_page_is_made_from_the_records() -> None:
    text = (DOCS / "scenes.md").read_text(encoding="utf-8")
    assert text == page(), "python -m spikerig.rigctl.sim.page > docs/scenes.md"
    for words in ("`path_px`", "(effects.md)", "`test_every`", "| `radius` | *required* |", "Siemens"):
        assert words in text


def test_the_page_of_effects_is_made_from_the_classes() -> None:
    text = (DOCS / "effects.md").read_text(encoding="utf-8")
    assert text == effects_page(), "python -m spikerig.rigctl.sim.effects_page > docs/effects.md"
    for words in (*(f"### `{name}`" for name in EFFECTS), "`threshold_e`", "electrons a spike", "### `gopro9`"):
        assert words in text
