"""Tables as Markdown, the paper's rows above what is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence

from evaluation.paper.published import SIZES, Row
from evaluation.paper.study import Curve


def action_table(
    columns: Sequence[str], published: Sequence[Row], measured: Sequence[Row], *, by_action: bool
) -> str:
    """Rows by action with mean and median; ``by_action``: the published ones have these actions."""
    lines = [
        "| | " + " | ".join((*columns, "**Avg.**", "Median")) + " |",
        "|---|" + "---|" * (len(columns) + 2),
    ]
    for row in published:
        actions = row.actions if by_action and row.actions else (math.nan,) * len(columns)
        lines.append(_line(row.label, actions, row, 2))
    lines += [_line(f"**{row.label}**", row.actions, row, 1) for row in measured]
    return "\n".join(lines)


def short_table(pairs: Sequence[tuple[Row | None, Row | None]]) -> str:
    """Mean and median, the paper's beside ours; either may be missing."""
    lines = ["| | paper: avg. / median | here: avg. / median |", "|---|---|---|"]
    for theirs, ours in pairs:
        label = (ours or theirs or Row("")).label
        lines.append(f"| {label} | {_both(theirs, 2)} | {_both(ours, 1)} |")
    return "\n".join(lines)


def size_table(curve: Curve, line: str) -> str:
    """Table 3: mean by library size."""
    lines = ["| | 2D source | 3D source | avg. |", "|---|---|---|---|"]
    ours = line.replace("|", " given ")
    lines += [
        f"| {row.label} | {row.thousands_2d:,}k | {row.thousands_3d:,}k | {row.mean:.2f} |"
        for row in SIZES
    ]
    lines += [
        f"| **here, {ours}** | {size / 1e3:,.0f}k | {size / 1e3:,.0f}k | {mean:.1f} |"
        for size, mean in zip(curve.sizes, curve.mean[line], strict=True)
    ]
    return "\n".join(lines)


def curve_table(curve: Curve) -> str:
    """Figures 7 and 8 in numbers: mean / median."""
    lines = [
        "| exemplars | " + " | ".join(f"{size:,}" for size in curve.sizes) + " |",
        "|---|" + "---|" * len(curve.sizes),
    ]
    for name, means in curve.mean.items():
        cells = [
            f"{mean:.1f} / {median:.1f}"
            for mean, median in zip(means, curve.median[name], strict=True)
        ]
        lines.append("| " + name.replace("|", " given ") + " | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _line(label: str, actions: Sequence[float], row: Row, digits: int) -> str:
    cells = [*actions, row.mean, row.median]
    return f"| {label} | " + " | ".join(_number(cell, digits) for cell in cells) + " |"


def _both(row: Row | None, digits: int) -> str:
    if row is None:
        return "-"
    return f"{_number(row.mean, digits)} / {_number(row.median, digits)}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"
