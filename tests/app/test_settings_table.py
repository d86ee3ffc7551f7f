from pathlib import Path

from app.settings_table import END, START, renewed

PAGE = Path(__file__).parents[2] / "docs" / "operations.md"


def test_the_documented_settings_are_those_of_the_class() -> None:
    text = PAGE.read_text()
    assert START in text
    assert END in text
    assert renewed(text) == text, "run scripts/settings-table"
