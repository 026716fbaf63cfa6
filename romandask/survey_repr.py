"""How a survey shows itself: as text, and in a notebook as HTML with a map of its region, tiles and exposures."""

from __future__ import annotations

import html
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from romandask.stage_graph import stage_products
from romandask.stages.pointings import corners_of
from romandask.stages.stage import SurveyContext
from romandask.storage.paths import AnyPath, bytes_below
from romandask.storage.store import Store

_MAP_PIXELS = 320
"""Width of the map."""
_MOST_OUTLINES = 500
"""Largest number of exposures drawn for a telescope; of more, every second, third and so on is drawn."""
_DEEPEST = 30
"""Largest mean number of overlapping exposures drawn for a telescope."""
_MARGIN = 1.6
"""Width of the map over that of the tiles."""
_COLOURS = ("#c0392b", "#2471a3", "#8e44ad", "#d68910")
"""Colours of the telescopes."""


@dataclass(frozen=True)
class StageLine:
    """What a store has of a stage."""

    stage: str
    units: int
    bytes: int
    """On disk."""


def stage_lines(survey: SurveyContext) -> list[StageLine]:
    """Return what the store of a survey has of each stage that has units, in the order of the plan."""
    store = survey.store
    if store is None:
        return []
    lines = []
    for one in stage_products(survey):
        units = len(store.recorded(one.name))
        if units:
            tables = [f"{one.name}_{name}" for name in one.stage.tables]
            lines.append(StageLine(one.name, units, sum(map(_bytes, _places(store, one.name, tables)))))
    return lines


def _places(store: Store, name: str, tables: list[str]) -> list[AnyPath]:
    """Return where a product and the tables beside it may be."""
    folders = [store.images(name), store.table(name), *(store.root / table for table in tables)]
    catalog = store.catalog(name)
    # a HATS catalog has a folder of its own in its collection
    return [*folders, catalog if catalog.exists() else store.root / name]


def _bytes(path: AnyPath) -> int:
    if path.is_file():
        return int(path.stat().st_size)
    return bytes_below(path) if path.exists() else 0


def _shown(root: AnyPath) -> str:
    """Return the path of a store, relative to the working directory if it is below it."""
    below = isinstance(root, Path) and root.is_relative_to(Path.cwd())
    return str(root.relative_to(Path.cwd()) if below else root)


def _size(number: int) -> str:
    """Return a number of bytes as text."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if number >= factor:
            return f"{number / factor:,.1f} {unit}"
    return f"{number / 1e3:,.1f} kB"


def text_of(survey: SurveyContext) -> str:
    """Return the survey as text: its name, where it is stored, and a line a stage."""
    place = _shown(survey.store.root) if survey.store else "not stored"
    lines = [f"Survey {survey.pipeline.name} ({place})"]
    lines += [f"  {line.stage:24s} {line.units:6d} units {_size(line.bytes):>10s}" for line in stage_lines(survey)]
    return "\n".join(lines)


def html_of(survey: SurveyContext) -> str:
    """Return the survey as HTML: the same, with a map of its region, tiles and exposures."""
    region, lines = survey.region, stage_lines(survey)
    place = html.escape(_shown(survey.store.root) if survey.store else "not stored: products are made on demand")
    about = [
        f"RA {region.ra_min:g} to {region.ra_max:g}, Dec {region.dec_min:g} to {region.dec_max:g} degrees, "
        f"{region.area:.2f} square arcminutes, {len(survey.tiles)} tiles"
    ]
    about += [f"{one.title}: {', '.join(one.bands)}" for one in survey.instruments.values()]
    rows = "".join(
        f"<tr><td style='text-align:left'>{html.escape(line.stage)}</td><td>{line.units}</td>"
        f"<td>{_size(line.bytes)}</td></tr>"
        for line in lines
    )
    total = sum(line.bytes for line in lines)
    table = (
        f"<details><summary>{sum(line.units for line in lines)} units of {len(lines)} stages, "
        f"{_size(total)} on disk</summary><table><thead><tr><th style='text-align:left'>stage</th><th>units</th>"
        f"<th>on disk</th></tr></thead><tbody>{rows}</tbody></table></details>"
        if lines
        else ""
    )
    texts = "".join(f"<div>{html.escape(text)}</div>" for text in about)
    return (
        "<div style='display:flex;gap:1.5em;align-items:flex-start'>"
        f"<div><b>Survey {html.escape(survey.pipeline.name)}</b> <code>{place}</code>{texts}{table}</div>"
        f"<div>{footprint_svg(survey)}</div></div>"
    )


def footprint_svg(survey: SurveyContext) -> str:
    """Return a map (SVG) of the region, the tiles and the stored pointings, with a legend below it.

    North is up and east is left. Exposures are transparent: where more of them overlap, the map is darker.
    """
    region, (ra, dec) = survey.region, survey.region.centre
    stretch = np.cos(np.radians(dec))

    def plane(corners: np.ndarray) -> np.ndarray:
        """Return offsets (..., 2), degrees to the west and to the south, of positions (..., 2)."""
        return np.stack([-((corners[..., 0] - ra + 180) % 360 - 180) * stretch, -(corners[..., 1] - dec)], axis=-1)

    east, west = region.ra_min + region.width, region.ra_min
    edge = np.array([(west, region.dec_min), (east, region.dec_min), (east, region.dec_max), (west, region.dec_max)])
    grid = survey.pipeline.coadds.grid()
    tiles = np.stack([tile.corners(grid.inner) for tile in survey.tiles])
    outlines = {
        name: plane(corners_of(survey.pointings(name)))
        for name in survey.instruments
        if survey.store is not None and survey.store.table(f"pointings/{name}", "all").exists()
    }
    shown = plane(np.concatenate([tiles.reshape(-1, 2), edge]))
    # a region smaller than an exposure is shown with the exposures around it
    extents = [np.ptp(corners, axis=1).max() for corners in outlines.values() if len(corners)]
    size = max(np.ptp(shown, axis=0).max() * _MARGIN, 2 * min(extents, default=0.0))
    low = shown.min(axis=0) - (size - np.ptp(shown, axis=0)) / 2

    def drawn(polygons: np.ndarray, fill: str, opacity: float, stroke: str, width: float = 1.0) -> str:
        points = (" ".join(f"{x:.1f},{y:.1f}" for x, y in corner) for corner in (polygons - low) * _MAP_PIXELS / size)
        shapes = "".join(f"<polygon points='{one}'/>" for one in points)
        return f"<g fill='{fill}' fill-opacity='{opacity:g}' stroke='{stroke}' stroke-width='{width}'>{shapes}</g>"

    layers: list[str] = []
    legend: list[str] = []
    for number, (name, corners) in enumerate(outlines.items()):
        colour = _COLOURS[number % len(_COLOURS)]
        # depth of the overlap, were the exposures spread over the map
        depth = np.prod(np.ptp(corners, axis=1), axis=1).sum() / size**2
        step = max(1, int(np.ceil(depth / _DEEPEST)), int(np.ceil(len(corners) / _MOST_OUTLINES)))
        opacity = float(np.clip(0.4 * step / max(depth, 1e-9), 0.01, 0.1))
        layers.insert(0, drawn(corners[::step], colour, opacity, colour, 0.15))
        title = html.escape(survey.instruments[name].title)
        legend.append(f"<span style='color:{colour}'>{title}: {len(corners)} exposures</span>")
    layers += [drawn(plane(tiles), "none", 0, "#555555"), drawn(plane(edge)[None], "none", 0, "#000000")]
    legend += ["<span style='color:#555555'>tiles</span>", "region"]
    return (
        f"<svg width='{_MAP_PIXELS}' height='{_MAP_PIXELS}' viewBox='0 0 {_MAP_PIXELS} {_MAP_PIXELS}' "
        f"style='background:#fff;border:1px solid #ccc'>{''.join(layers)}</svg>"
        f"<div style='font-size:85%'>{', '.join(legend)}; {size * 60:.3g} arcmin wide</div>"
    )
