"""docs/hardware/vidar.md and the udev rules say what the code says."""

from pathlib import Path

from spikerig.rigctl.ft60x import PRODUCTS, VENDOR
from spikerig.rigctl.profile_page import BEGIN, END, WHY, tables
from spikerig.rigctl.profiles import PROFILES
from spikerig.rigctl.usbport import udev_rule

DOCS = Path(__file__).resolve().parents[2] / "docs" / "hardware"


def test_the_page_holds_the_profiles_tables():
    page = (DOCS / "vidar.md").read_text(encoding="utf-8")
    assert page.split(BEGIN)[1].split(END)[0].strip() == tables()
    assert all(f"`{name}`" in page for name in PROFILES)


def test_every_field_says_how_sure_it_is_and_why():
    for profile in PROFILES.values():
        assert set(WHY) == set(profile.sure)
        assert all(profile.framing in why or "" in why for why in WHY.values())


def test_the_shipped_rules_are_what_the_error_prints():
    rules = (DOCS / "70-spikerig.rules").read_text(encoding="utf-8").splitlines()
    assert [r for r in rules if not r.startswith("#")] == [udev_rule(VENDOR, p) for p in PRODUCTS]
