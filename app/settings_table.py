"""The table of settings in docs/operations.md, made from the class so that it cannot lag behind."""

from __future__ import annotations

from app.page_table import renew_page, with_table
from app.settings import ENV_PREFIX, Settings

START, END = "<!-- settings: scripts/settings-table -->", "<!-- end of settings -->"
_COMPUTED = {
    "cache_dir": "~/.cache/posematch",
    "workers": "the cores available",
    "weights_dir": "models/weights",
}


def settings_table() -> str:
    """Markdown: variable, default, meaning."""
    rows = ["| variable | default | meaning |", "|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = _COMPUTED.get(name)
        if default is None:
            value = field.default
            default = "none" if value is None or value == () else f"`{value}`"
        rows.append(f"| `{ENV_PREFIX}{name.upper()}` | {default} | {field.description} |")
    return "\n".join(rows)


def renewed(text: str) -> str:
    """``text`` of a page with the table between the two marks renewed."""
    return with_table(text, START, END, settings_table())


if __name__ == "__main__":
    renew_page(renewed)
