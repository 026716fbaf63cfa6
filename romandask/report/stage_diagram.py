"""The picture of the stages: what each kind is made from, and how many units of it there are."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from romandask.run import PlannedStage
from romandask.stage_graph import StageProduct, stage_products
from romandask.survey import Survey


def dag_svg(survey: Survey, rows: list[PlannedStage], path: Path) -> None:
    """Write the stages of a survey as an SVG picture: a box a kind with its units, arrows from what it is made from.

    Parameters
    ----------
    survey : Survey
    rows : list of PlannedStage
        The survey's plan.
    path : Path
        The SVG file.
    """
    lines: dict[str, list[str]] = {}
    for row in rows:
        kind, part = row.stage.split("/")
        lines.setdefault(kind, [kind]).append(f"{part}: {row.units}")
    arrows = _reduced(kinds_read(stage_products(survey)))
    columns: dict[int, list[str]] = {}
    for kind in lines:
        columns.setdefault(_column(kind, arrows), []).append(kind)
    figure = Figure(figsize=(2.2 * len(columns), 1 + 2.2 * max(map(len, columns.values()))), layout="constrained")
    axes = figure.add_subplot()
    boxes = {}
    for column, kinds in columns.items():
        for place, kind in enumerate(kinds):
            boxes[kind] = column, (len(kinds) - 1) / 2 - place
    _draw(axes, {kind: "\n".join(text) for kind, text in lines.items()}, boxes, arrows)
    axes.set_xlim(-0.6, len(columns) - 0.4)
    reach = max(map(len, columns.values())) / 2
    axes.set_ylim(-reach, reach)
    axes.set_axis_off()
    # text stays text, so that it can be searched and read aloud
    with rc_context({"svg.fonttype": "none"}):
        figure.savefig(path, format="svg")


def kinds_read(products: list[StageProduct]) -> dict[str, set[str]]:
    """Return, by kind of stage, the kinds that it is made from, or whose content decides which units it has."""
    arrows: dict[str, set[str]] = {}
    for one in products:
        sources = {name.split("/")[0] for name in one.reads | one.known_after}
        arrows.setdefault(one.kind, set()).update(sources - {one.kind})
    return arrows


def _reduced(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """Leave out the arrows that others make unnecessary."""

    def all_before(kind: str) -> set[str]:
        return arrows[kind].union(*(all_before(source) for source in arrows[kind]))

    return {
        kind: {source for source in sources if not any(source in all_before(other) for other in sources)}
        for kind, sources in arrows.items()
    }


def _depth(kind: str, arrows: dict[str, set[str]]) -> int:
    return 1 + max((_depth(source, arrows) for source in arrows[kind]), default=-1)


def _column(kind: str, arrows: dict[str, set[str]]) -> int:
    """Return how many come before a kind; of one that is made from nothing, just before what is made from it."""
    users = [_depth(user, arrows) for user, sources in arrows.items() if kind in sources]
    return min(users) - 1 if users and not arrows[kind] else _depth(kind, arrows)


def _draw(
    axes: Axes, texts: dict[str, str], places: dict[str, tuple[float, float]], arrows: dict[str, set[str]]
) -> None:
    style = {"boxstyle": "round", "fc": "#e8eef6", "ec": "#45607f"}
    boxes = {
        kind: axes.text(*places[kind], text, ha="center", va="center", fontsize=9, bbox=style, zorder=2)
        for kind, text in texts.items()
    }
    for kind, sources in arrows.items():
        for source in sorted(sources):
            ends = {"patchA": boxes[source].get_bbox_patch(), "patchB": boxes[kind].get_bbox_patch()}
            axes.annotate(
                "",
                places[kind],
                places[source],
                zorder=1,
                arrowprops={"arrowstyle": "->", "color": "#45607f", "shrinkA": 0, "shrinkB": 2, **ends},
            )
