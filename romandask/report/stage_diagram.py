"""Diagram of the stages: which stages each stage reads, and its number of units."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from romandask.run import PlannedStage
from romandask.stage_graph import StageProduct, stage_products
from romandask.survey import Survey


def write_stage_diagram(survey: Survey, rows: list[PlannedStage], path: Path) -> None:
    """Write a diagram of the stages of a survey to an SVG file.

    Each kind of stage (the first part of the names) is a box that lists its stages and their numbers of units. Arrows
    point to it from the kinds that it reads directly.

    Parameters
    ----------
    survey : Survey
        The survey.
    rows : list of PlannedStage
        Plan of the survey.
    path : Path
        Destination.
    """
    lines: dict[str, list[str]] = {}
    for row in rows:
        kind, part = row.stage.split("/")
        lines.setdefault(kind, [kind]).append(f"{part}: {row.units}")
    sources = _reduced(kinds_read(stage_products(survey)))
    columns: dict[int, list[str]] = {}
    for kind in lines:
        columns.setdefault(_column(kind, sources), []).append(kind)
    figure = Figure(figsize=(2.2 * len(columns), 1 + 2.2 * max(map(len, columns.values()))), layout="constrained")
    axes = figure.add_subplot()
    positions: dict[str, tuple[float, float]] = {}
    for column, kinds in columns.items():
        for row_number, kind in enumerate(kinds):
            positions[kind] = column, (len(kinds) - 1) / 2 - row_number
    _draw(axes, {kind: "\n".join(text) for kind, text in lines.items()}, positions, sources)
    axes.set_xlim(-0.6, len(columns) - 0.4)
    half_height = max(map(len, columns.values())) / 2
    axes.set_ylim(-half_height, half_height)
    axes.set_axis_off()
    # text is written as text, not as paths, for search and screen readers
    with rc_context({"svg.fonttype": "none"}):
        figure.savefig(path, format="svg")


def kinds_read(products: list[StageProduct]) -> dict[str, set[str]]:
    """Return, for each kind of stage, the kinds that it reads or whose content determines its units."""
    sources: dict[str, set[str]] = {}
    for product in products:
        kinds = {name.split("/")[0] for name in product.reads | product.known_after}
        sources.setdefault(product.kind, set()).update(kinds - {product.kind})
    return sources


def _reduced(sources: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the direct sources of each kind: those that are not also sources of another source."""

    def ancestors(kind: str) -> set[str]:
        return sources[kind].union(*(ancestors(source) for source in sources[kind]))

    return {
        kind: {source for source in direct if not any(source in ancestors(other) for other in direct)}
        for kind, direct in sources.items()
    }


def _depth(kind: str, sources: dict[str, set[str]]) -> int:
    """Return the length of the longest chain of sources of a kind."""
    return 1 + max((_depth(source, sources) for source in sources[kind]), default=-1)


def _column(kind: str, sources: dict[str, set[str]]) -> int:
    """Return the column of a kind: its depth, or for a kind without sources the column before its first reader."""
    readers = [_depth(reader, sources) for reader, read in sources.items() if kind in read]
    return min(readers) - 1 if readers and not sources[kind] else _depth(kind, sources)


def _draw(
    axes: Axes, texts: dict[str, str], positions: dict[str, tuple[float, float]], sources: dict[str, set[str]]
) -> None:
    style = {"boxstyle": "round", "fc": "#e8eef6", "ec": "#45607f"}
    boxes = {
        kind: axes.text(*positions[kind], text, ha="center", va="center", fontsize=9, bbox=style, zorder=2)
        for kind, text in texts.items()
    }
    for kind, direct in sources.items():
        for source in sorted(direct):
            ends = {"patchA": boxes[source].get_bbox_patch(), "patchB": boxes[kind].get_bbox_patch()}
            axes.annotate(
                "",
                positions[kind],
                positions[source],
                zorder=1,
                arrowprops={"arrowstyle": "->", "color": "#45607f", "shrinkA": 0, "shrinkB": 2, **ends},
            )
