"""An atlas: the coadds of all surveys as one page to drag and zoom in, with its pictures and without external assets.

The pictures of a survey are a pyramid over one gnomonic plane about the middle of the region, north up, east left; a
picture of a level shows what four of the level below show. A place of the plane has the pixel of the tile that owns it.
"""

from __future__ import annotations

import io
import itertools
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.wcs import WCS
from PIL import Image

from romandask.export.files import make_folder
from romandask.model.errors import UserError
from romandask.model.sky import from_tangent_plane
from romandask.model.tiles import tangent_header
from romandask.report.figures import coloured, noise_of, three_of
from romandask.stages.coadds.tile_maker import Coadds
from romandask.storage.paths import write_bytes
from romandask.survey import Survey

PICTURE_PIXELS = 512
"""Pixels a side of a picture."""
WIDEST = 40.0
"""Degrees that one gnomonic plane shows well."""
_SAMPLE = 1024
"""Pixels a side of the middle of a tile that tells a band's noise."""


@dataclass(frozen=True)
class Plane:
    """The plane of the atlas; its pixels are those of the finest survey."""

    ra: float
    """Centre, degrees."""
    dec: float
    """Centre, degrees."""
    scale: float
    """Arcsec a pixel."""
    width: int
    """Pixels, east to west."""
    height: int
    """Pixels, north to south."""
    side: int = PICTURE_PIXELS

    @property
    def top(self) -> int:
        """The level at which one picture shows all."""
        return max(0, int(np.ceil(np.log2(max(self.width, self.height) / self.side))))

    def sky(self, level: int, row: int, column: int) -> tuple[np.ndarray, np.ndarray]:
        """Return right ascension and declination (side, side), degrees, of the pixels of a picture."""
        step = 2**level
        x = (np.arange(column * self.side, (column + 1) * self.side) + 0.5) * step - self.width / 2
        y = (np.arange(row * self.side, (row + 1) * self.side) + 0.5) * step - self.height / 2
        return from_tangent_plane(self.ra, self.dec, *np.meshgrid(-x * self.scale / 3600, -y * self.scale / 3600))


@dataclass(frozen=True)
class Layer:
    """The coadds of one survey, as colours."""

    coadds: Coadds
    plane: Plane

    @cached_property
    def bands(self) -> tuple[str, ...]:
        """The bands that are red, green and blue."""
        return three_of(self.coadds.instrument.picture_bands)

    @property
    def finest(self) -> int:
        """The lowest level: finer pictures would show a pixel as several."""
        return max(0, int(np.floor(np.log2(self.coadds.instrument.coadd_scale / self.plane.scale) + 1e-6)))

    @cached_property
    def numbers(self) -> dict[int, int]:
        """Numbers of the tiles of which all three bands are stored, by their ids."""
        found = {tile.id: number for number, tile in enumerate(self.coadds.tiles)}
        return {key: k for key, k in found.items() if all(self.coadds.has(self.unit(k, b)) for b in self.bands)}

    @cached_property
    def noise(self) -> dict[str, float]:
        """Scatter of the sky by band, from the middle of a tile."""
        middle = sorted(self.numbers.values())[len(self.numbers) // 2]
        first = max(0, (self.coadds.pixels - _SAMPLE) // 2)
        window = (slice(first, first + _SAMPLE),) * 2
        return {b: noise_of(self.coadds.load(self.unit(middle, b), ("image",), window)["image"]) for b in self.bands}

    def unit(self, tile: int, band: str) -> int:
        """Return the number of the unit of a tile and band."""
        return self.coadds.index(tile, band)

    def sampled(self, row: int, column: int) -> np.ndarray:
        """Return a picture (3, side, side) of the finest level in units of the noise; NaN where nothing is."""
        ra, dec = self.plane.sky(self.finest, row, column)
        owners = self.coadds.settings.grid().owner(ra, dec)
        out = np.full((3, *ra.shape), np.nan, np.float32)
        for owner in np.unique(owners).tolist():
            if owner not in self.numbers:
                continue
            here = owners == owner
            tile = self.numbers[owner]
            x, y = (np.rint(v).astype(int) for v in self.coadds.wcs(tile).wcs_world2pix(ra[here], dec[here], 0))
            inside = (x >= 0) & (y >= 0) & (x < self.coadds.pixels) & (y < self.coadds.pixels)
            if not inside.any():
                continue
            x, y, places = x[inside], y[inside], np.flatnonzero(here)[inside]
            window = slice(y.min(), y.max() + 1), slice(x.min(), x.max() + 1)
            # where there are few bands one is two colours, and read once
            for band, noise in self.noise.items():
                found = self.coadds.load(self.unit(tile, band), ("image", "weight"), window)
                values = np.where(found["weight"] > 0, found["image"] / noise, np.nan)
                for plane in (plane for plane, name in zip(out, self.bands, strict=True) if name == band):
                    plane.flat[places] = values[y - window[0].start, x - window[1].start]
        return out


def write_sky_viewer(survey: Survey, folder: Path) -> Path:
    """Write a page of a survey's coadds, and its pictures, and return where it is.

    Raises
    ------
    UserError
        If no coadds are stored, or the region is too wide for one plane.
    """
    plane = _plane(survey)
    layers = {name: Layer(survey.output(f"coadds/{name}"), plane) for name in survey.instruments}
    layers = {name: layer for name, layer in layers.items() if layer.numbers}
    if not layers:
        raise UserError("no coadds are stored: romandask run makes them")
    make_folder(folder)
    shown = []
    for name, layer in layers.items():
        _pictures(layer, folder / name, max(plane.top, layer.finest), 0, 0)
        shown.append({"name": name, "finest": layer.finest, "bands": list(dict.fromkeys(layer.bands))})
    content = {"name": survey.pipeline.name, "top": plane.top, "surveys": shown} | asdict(plane)
    page = (Path(__file__).parent / "sky_viewer.html").read_text()
    # in a script </ would end it
    data = json.dumps(content).replace("</", "<\\/")
    write_bytes(folder / "index.html", page.replace("/*ATLAS*/null", data).encode())
    return folder / "index.html"


def _plane(survey: Survey) -> Plane:
    region, grid = survey.region, survey.pipeline.coadds.grid()
    ra, dec = region.ra_min + region.width / 2, (region.dec_min + region.dec_max) / 2
    scale = min(instrument.coadd_scale for instrument in survey.instruments.values())
    corners = np.concatenate([tile.corners(grid.inner) for tile in survey.tiles])
    extent = max(region.width * np.cos(np.radians(dec)), region.dec_max - region.dec_min)
    if extent > WIDEST:
        raise UserError(f"the region is {extent:.0f} degrees wide, one page shows {WIDEST:.0f}: run a part of it")
    frame = WCS(tangent_header(ra % 360, dec, 1, scale))
    x, y = frame.wcs_world2pix(corners[:, 0], corners[:, 1], 0)
    # the tiles need not lie evenly about the middle of the region
    width, height = (2 * int(np.ceil(np.abs(v).max())) for v in (x, y))
    return Plane(ra % 360, dec, scale, width, height)


def _pictures(layer: Layer, folder: Path, level: int, row: int, column: int) -> np.ndarray | None:
    """Write a picture and all below it; return its planes (3, side, side), None where nothing is."""
    plane, side = layer.plane, layer.plane.side
    if row * side * 2**level >= plane.height or column * side * 2**level >= plane.width:
        return None
    if level == layer.finest:
        planes = layer.sampled(row, column)
    else:
        four = np.full((3, 2 * side, 2 * side), np.nan, np.float32)
        for down, right in itertools.product(range(2), repeat=2):
            part = _pictures(layer, folder, level - 1, 2 * row + down, 2 * column + right)
            if part is not None:
                four[:, down * side : (down + 1) * side, right * side : (right + 1) * side] = part
        planes = _halved(four)
    if not np.isfinite(planes).any():
        return None
    write_bytes(folder / str(level) / f"{row}_{column}.jpg", _jpeg(planes))
    return planes


def _halved(planes: np.ndarray) -> np.ndarray:
    """Return planes of half the side, each pixel the mean of those of four that are there."""
    three, height, width = planes.shape
    parts = planes.reshape(three, height // 2, 2, width // 2, 2)
    there = np.isfinite(parts)
    count = there.sum(axis=(2, 4))
    total = np.where(there, parts, 0).sum(axis=(2, 4))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _jpeg(planes: np.ndarray) -> bytes:
    there = np.isfinite(planes).all(axis=0)
    picture = coloured(np.nan_to_num(planes))
    # what is not there is as the page behind it
    picture[~there] = (16, 18, 24)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=90, subsampling=0)
    return buffer.getvalue()
