"""Generated tables in pages: what stands between two marks is made anew, the rest stays."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path


def with_table(text: str, start: str, end: str, table: str) -> str:
    """``text`` of a page with ``table`` between the marks ``start`` and ``end``."""
    before, _, rest = text.partition(start)
    _, _, after = rest.partition(end)
    return f"{before}{start}\n{table}\n{end}{after}"


def renew_page(renewed: Callable[[str], str]) -> None:
    """Put the page named on the command line through ``renewed``."""
    page = Path(sys.argv[1])
    page.write_text(renewed(page.read_text()))
