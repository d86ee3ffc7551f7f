"""The table of settings in docs/operations.md, made from the class so that it cannot lag behind."""

from __future__ import annotations

import sys
from pathlib import Path

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
    before, _, rest = text.partition(START)
    _, _, after = rest.partition(END)
    return f"{before}{START}\n{settings_table()}\n{END}{after}"


def main() -> None:
    """Renew the page named on the command line."""
    page = Path(sys.argv[1])
    page.write_text(renewed(page.read_text()))


if __name__ == "__main__":
    main()
