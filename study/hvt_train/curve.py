"""The training curve as a picture (SVG), from the log of a run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

__all__ = ["draw_curve"]

_SIZE = (720, 300)
_MARGIN = (52, 16, 52, 40)  # left, top, right, bottom
_STYLE = "font-family:sans-serif;font-size:12px"

Series = Sequence[tuple[float, float]]


def draw_curve(log: Path, out: Path, *, title: str, quality: str) -> None:
    """Draw loss (left axis) and what the checks measured (right axis, 0…1) over the steps of a log.

    Args:
        log: JSON lines of `hvt_train.learning.loop.train`.
        out: the SVG file.
        title: above the curve.
        quality: what the right axis shows.
    """
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    losses = [(row["step"], row["loss"]) for row in rows if "loss" in row]
    checks = [(row["step"], row["validation"]) for row in rows if "validation" in row]
    last = max(step for step, _ in losses)
    top = max(loss for _, loss in losses)
    wide, high = _SIZE
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{high}" style="{_STYLE}">',
        f'<rect width="{wide}" height="{high}" fill="white"/>',
        *_axes(last, top, title=title, quality=quality),
        _line(losses, (last, top), colour="#3060b0"),
        _line(checks, (last, 1.0), colour="#c04020"),
        *(_dot(point, (last, 1.0), colour="#c04020") for point in checks),
        "</svg>",
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join(part for part in parts if part) + "\n", encoding="utf-8")


def _at(point: tuple[float, float], most: tuple[float, float]) -> tuple[float, float]:
    left, top, right, bottom = _MARGIN
    x = left + point[0] / most[0] * (_SIZE[0] - left - right)
    y = _SIZE[1] - bottom - point[1] / most[1] * (_SIZE[1] - top - bottom)
    return round(x, 1), round(y, 1)


def _line(points: Series, most: tuple[float, float], *, colour: str) -> str:
    if len(points) < 2:
        return ""
    path = " ".join(f"{x},{y}" for x, y in (_at(point, most) for point in points))
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"/>'


def _dot(point: tuple[float, float], most: tuple[float, float], *, colour: str) -> str:
    x, y = _at(point, most)
    return f'<circle cx="{x}" cy="{y}" r="3" fill="{colour}"/>'


def _axes(last: float, top: float, *, title: str, quality: str) -> list[str]:
    parts = [f'<text x="{_MARGIN[0]}" y="12">{title}</text>']
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x0, y = _at((0, share), (1, 1))
        x1, _ = _at((1, share), (1, 1))
        parts.append(f'<line x1="{x0}" y1="{y}" x2="{x1}" y2="{y}" stroke="#ddd"/>')
        parts.append(
            f'<text x="{x0 - 6}" y="{y + 4}" text-anchor="end" fill="#3060b0">{share * top:.1f}</text>'
        )
        parts.append(f'<text x="{x1 + 6}" y="{y + 4}" fill="#c04020">{share:.2f}</text>')
        x, low = _at((share, 0), (1, 1))
        parts.append(f'<text x="{x}" y="{low + 16}" text-anchor="middle">{share * last:.0f}</text>')
    x, y = _at((0.5, 0), (1, 1))
    parts.append(f'<text x="{x}" y="{y + 32}" text-anchor="middle">steps; blue: loss, red: {quality}</text>')
    return parts
