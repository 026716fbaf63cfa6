"""How a survey shows itself: as text, and in a notebook as HTML with a map of its region, tiles and exposures."""

from __future__ import annotations

import html
from dataclasses import dataclass

import numpy as np

from romandask.stage_graph import stage_products
from romandask.stages.stage import SurveyContext
from romandask.storage.paths import AnyPath, bytes_below
from romandask.storage.store import Store

_MAP_PIXELS = 320
"""Width of the map."""
_MOST_OUTLINES = 2000
"""Exposures whose outlines are drawn; of more an even selection is."""


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


def text_of(survey: SurveyContext) -> str:
    """Return the survey as text: its name, where it is stored, and a line a stage."""
    place = survey.store.root if survey.store else "not stored"
    lines = [f"Survey {survey.pipeline.name} ({place})"]
    lines += [f"  {line.stage:22s} {line.units:6d} units {line.bytes / 1e6:12.1f} MB" for line in stage_lines(survey)]
    return "\n".join(lines)


def html_of(survey: SurveyContext) -> str:
    """Return the survey as HTML: the same, with a map of its region, tiles and exposures."""
    region, lines = survey.region, stage_lines(survey)
    place = html.escape(str(survey.store.root) if survey.store else "not stored: products are made on demand")
    about = [
        f"RA {region.ra_min:g} to {region.ra_max:g}, Dec {region.dec_min:g} to {region.dec_max:g} degrees, "
        f"{region.area:.2f} square arcminutes, {len(survey.tiles)} tiles"
    ]
    about += [f"{one.title}: {', '.join(one.bands)}" for one in survey.instruments.values()]
    rows = "".join(
        f"<tr><td style='text-align:left'>{html.escape(line.stage)}</td><td>{line.units}</td>"
        f"<td>{line.bytes / 1e6:,.1f}</td></tr>"
        for line in lines
    )
    total = sum(line.bytes for line in lines)
    table = (
        f"<details><summary>{sum(line.units for line in lines)} units of {len(lines)} stages, "
        f"{total / 1e6:,.0f} MB on disk</summary><table><thead><tr><th style='text-align:left'>stage</th><th>units</th>"
        f"<th>MB on disk</th></tr></thead><tbody>{rows}</tbody></table></details>"
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
    """Return a map (SVG): the tiles, the region, and the exposures that the store knows of."""
    region, (ra, dec) = survey.region, survey.region.centre
    stretch = np.cos(np.radians(dec))

    def plane(corners: np.ndarray) -> np.ndarray:
        """Return offsets (..., 2), degrees to the west and to the south, of positions (..., 2)."""
        return np.stack([-((corners[..., 0] - ra + 180) % 360 - 180) * stretch, -(corners[..., 1] - dec)], axis=-1)

    east, west = region.ra_min + region.width, region.ra_min
    edge = np.array([(west, region.dec_min), (east, region.dec_min), (east, region.dec_max), (west, region.dec_max)])
    grid = survey.pipeline.coadds.grid()
    tiles = np.stack([tile.corners(grid.inner) for tile in survey.tiles])
    shapes = [("#d7e3f4", "#45607f", plane(tiles))]
    for colour, name in zip(("#c0392b", "#2e7d32", "#8e44ad"), survey.instruments, strict=False):
        if survey.store is not None and survey.store.table(f"pointings/{name}", "all").exists():
            outlines = survey.pointings(name).filter(regex=r"^(ra|dec)_\d$")
            corners = outlines.to_numpy(float).reshape(-1, 4, 2)
            shapes.append(("none", colour, plane(corners[:: max(1, len(corners) // _MOST_OUTLINES)])))
    shapes.append(("none", "#000000", plane(edge)[None]))
    shown = plane(np.concatenate([tiles.reshape(-1, 2), edge]))
    low, size = shown.min(axis=0), np.ptp(shown, axis=0).max() * 1.3 or 1.0
    low = low - (size - np.ptp(shown, axis=0)) / 2
    scale = _MAP_PIXELS / size
    drawn = "".join(
        f"<polygon points='{_points((polygon - low) * scale)}' fill='{fill}' stroke='{stroke}' stroke-width='0.7'/>"
        for fill, stroke, polygons in shapes
        for polygon in polygons
    )
    titles = "tiles (blue), region (black), exposures by telescope (red, green)"
    return (
        f"<svg width='{_MAP_PIXELS}' height='{_MAP_PIXELS}' viewBox='0 0 {_MAP_PIXELS} {_MAP_PIXELS}' "
        f"style='background:#fff'><title>{titles}</title>{drawn}</svg>"
    )


def _points(polygon: np.ndarray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in polygon)
