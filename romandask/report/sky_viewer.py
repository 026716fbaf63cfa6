"""Sky viewer: the coadds of all surveys as one page to drag and zoom, without external assets.

The pictures of a survey are a pyramid on one gnomonic plane at the centre of the region, north up, east left. A picture
of a level covers four pictures of the level below. A position of the plane shows the pixel of the tile that owns it.
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
from romandask.report.pictures import noise_of, rgb_bands, rgb_picture
from romandask.stages.coadds.tile_maker import Coadds
from romandask.storage.paths import write_bytes
from romandask.survey import Survey

PICTURE_PIXELS = 512
"""Side of a picture, pixels."""
MAX_WIDTH = 40.0
"""Largest extent of a region that one gnomonic plane shows without strong distortion, degrees."""
_NOISE_SAMPLE = 1024
"""Side of the central part of a tile from which the noise of a band is measured, pixels."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """Tangent plane of the viewer; its pixels have the size of the smallest coadd pixels of all surveys."""

    ra: float
    """Right ascension of the centre, degrees."""
    dec: float
    """Declination of the centre, degrees."""
    scale: float
    """Pixel scale, arcsec."""
    width: int
    """Extent from east to west, pixels."""
    height: int
    """Extent from north to south, pixels."""
    side: int = PICTURE_PIXELS
    """Side of a picture, pixels."""

    @property
    def top(self) -> int:
        """Level at which one picture covers the whole plane."""
        return max(0, int(np.ceil(np.log2(max(self.width, self.height) / self.side))))

    def sky(self, level: int, row: int, column: int) -> tuple[np.ndarray, np.ndarray]:
        """Return right ascension and declination of the pixels of a picture, each of shape (side, side), degrees."""
        step = 2**level
        x = (np.arange(column * self.side, (column + 1) * self.side) + 0.5) * step - self.width / 2
        y = (np.arange(row * self.side, (row + 1) * self.side) + 0.5) * step - self.height / 2
        return from_tangent_plane(self.ra, self.dec, *np.meshgrid(-x * self.scale / 3600, -y * self.scale / 3600))


@dataclass(frozen=True)
class Layer:
    """Colour pictures of the coadds of one survey."""

    coadds: Coadds
    plane: Plane

    @cached_property
    def bands(self) -> tuple[str, ...]:
        """Red, green and blue band."""
        return rgb_bands(self.coadds.instrument.picture_bands)

    @property
    def finest(self) -> int:
        """Lowest level of the pyramid: at a lower one, a coadd pixel would cover several picture pixels."""
        return max(0, int(np.floor(np.log2(self.coadds.instrument.coadd_scale / self.plane.scale) + 1e-6)))

    @cached_property
    def numbers(self) -> dict[int, int]:
        """Numbers of the tiles whose three bands are stored, by tile id."""
        numbers = {tile.id: number for number, tile in enumerate(self.coadds.tiles)}
        return {key: k for key, k in numbers.items() if all(self.coadds.has_tile(k, b) for b in self.bands)}

    @cached_property
    def noise(self) -> dict[str, float]:
        """Noise of the sky by band, from the centre of the middle tile."""
        middle = sorted(self.numbers.values())[len(self.numbers) // 2]
        first = max(0, (self.coadds.pixels - _NOISE_SAMPLE) // 2)
        window = (slice(first, first + _NOISE_SAMPLE),) * 2
        return {b: noise_of(self.coadds.read(middle, b, ("image",), window)["image"]) for b in self.bands}

    def sampled(self, row: int, column: int) -> np.ndarray:
        """Return a picture of the lowest level in units of the noise.

        Returns
        -------
        ndarray, shape (3, side, side)
            Red, green and blue plane; NaN where no tile has data.
        """
        ra, dec = self.plane.sky(self.finest, row, column)
        owners = self.coadds.settings.grid().owner(ra, dec)
        out = np.full((3, *ra.shape), np.nan, np.float32)
        for owner in np.unique(owners).tolist():
            if owner not in self.numbers:
                continue
            owned = owners == owner
            tile = self.numbers[owner]
            x, y = (np.rint(v).astype(int) for v in self.coadds.wcs(tile).wcs_world2pix(ra[owned], dec[owned], 0))
            inside = (x >= 0) & (y >= 0) & (x < self.coadds.pixels) & (y < self.coadds.pixels)
            if not inside.any():
                continue
            x, y, pixels = x[inside], y[inside], np.flatnonzero(owned)[inside]
            window = slice(y.min(), y.max() + 1), slice(x.min(), x.max() + 1)
            # a band that is used for several colours is read once
            for band, noise in self.noise.items():
                arrays = self.coadds.read(tile, band, ("image", "weight"), window)
                values = np.where(arrays["weight"] > 0, arrays["image"] / noise, np.nan)
                for plane in (plane for plane, name in zip(out, self.bands, strict=True) if name == band):
                    plane.flat[pixels] = values[y - window[0].start, x - window[1].start]
        return out


def write_sky_viewer(survey: Survey, folder: Path) -> Path:
    """Write the viewer page of a survey and its pictures, and return the path of the page.

    Parameters
    ----------
    survey : Survey
        Survey with stored coadds.
    folder : Path
        Destination.

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
    # </ would end the script element
    data = json.dumps(content).replace("</", "<\\/")
    write_bytes(folder / "index.html", page.replace("/*ATLAS*/null", data).encode())
    return folder / "index.html"


def _plane(survey: Survey) -> Plane:
    region, grid = survey.region, survey.pipeline.coadds.grid()
    ra, dec = region.ra_min + region.width / 2, (region.dec_min + region.dec_max) / 2
    scale = min(instrument.coadd_scale for instrument in survey.instruments.values())
    corners = np.concatenate([tile.corners(grid.inner) for tile in survey.tiles])
    extent = max(region.width * np.cos(np.radians(dec)), region.dec_max - region.dec_min)
    if extent > MAX_WIDTH:
        raise UserError(f"the region is {extent:.0f} degrees wide, one page shows {MAX_WIDTH:.0f}: run a part of it")
    frame = WCS(tangent_header(ra % 360, dec, 1, scale))
    x, y = frame.wcs_world2pix(corners[:, 0], corners[:, 1], 0)
    # the plane is symmetric about the centre of the region, the tiles may not be
    width, height = (2 * int(np.ceil(np.abs(v).max())) for v in (x, y))
    return Plane(ra=ra % 360, dec=dec, scale=scale, width=width, height=height)


def _pictures(layer: Layer, folder: Path, level: int, row: int, column: int) -> np.ndarray | None:
    """Write a picture and all pictures of lower levels in it.

    Returns
    -------
    ndarray, shape (3, side, side), or None
        Planes of the picture in units of the noise; None if it has no data.
    """
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
    """Return planes of half the side; each pixel is the mean of the finite ones of four pixels."""
    colours, height, width = planes.shape
    parts = planes.reshape(colours, height // 2, 2, width // 2, 2)
    finite = np.isfinite(parts)
    count = finite.sum(axis=(2, 4))
    total = np.where(finite, parts, 0).sum(axis=(2, 4))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _jpeg(planes: np.ndarray) -> bytes:
    finite = np.isfinite(planes).all(axis=0)
    picture = rgb_picture(np.nan_to_num(planes))
    # pixels without data have the colour of the page
    picture[~finite] = (16, 18, 24)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=90, subsampling=0)
    return buffer.getvalue()
