"""Coadds: tiles in nJy with weight, noise realisation, number of exposures and PSF.

Roman's are drizzled from its exposures, one at a time; Rubin's are drawn directly from its cadence.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import sep
from astropy.wcs import WCS

from romandask.exposures import RenderExposure, cone, empty_variance, header_text
from romandask.instruments.exposure import EXPOSURE_COLUMNS, Exposure, Instrument, exposure_of, pixel_areas
from romandask.kernels.detector import noise_realisation, usable
from romandask.kernels.drizzle import Strip, Sums, pixel_map, strips
from romandask.kernels.fourier import POINT
from romandask.kernels.psf import PsfModel
from romandask.kernels.render import Scene, draw, draw_wide, plan_stamps
from romandask.kernels.scene import build_scene
from romandask.kernels.stack import stack
from romandask.model.config import CoaddSettings, RenderSettings
from romandask.model.seeds import rng
from romandask.model.sky import touching_pairs
from romandask.model.spectra import NJY_ZERO_POINT, Bandpass
from romandask.model.tiles import Tile, tangent_header
from romandask.pointings import corners_of
from romandask.psfs import flat_shares
from romandask.runtime.manifest import digest
from romandask.runtime.products import Coordinates, ImageProduct
from romandask.runtime.store import Variable
from romandask.runtime.units import LazyUnits, Unit

PSF_RADIUS = 3.0
"""Half the side of the PSF images, arcsec, for a pixel of 0.0575 arcsec; larger pixels get larger images."""
PSF_PHASES = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""Where in a native pixel the stars of the PSF image lie: undersampled, an image of a star depends on it."""
BACKGROUND_MESH = 256
"""Pixels of the mesh on which an exposure's background is estimated."""


def coadds(exposures: ImageProduct, tiles: list[Tile], settings: CoaddSettings) -> ImageProduct:
    """Return the lazy coadds of a survey's exposures: dims (tile, band, y, x).

    A tile reads its exposures one at a time from the exposures product: from the store where they are, rendered where
    not. The tiles of an instrument that is drawn from its cadence use the exposures' table and truth, and render none.
    """
    render = exposures.make
    if not isinstance(render, RenderExposure):
        raise TypeError("coadds need the product that exposures() returns")
    instrument, table = render.instrument, render.table
    grid = settings.grid()
    pixels = grid.pixels(instrument.coadd_scale)
    drawn = instrument.coadd_from == "pointings"
    footprints = np.stack([tile.corners(grid.side) for tile in tiles])
    members = _members(table, footprints, instrument.bands)
    maker = (DrawTile if drawn else DrizzleTile)(exposures, tuple(tiles), members, settings, pixels, render.render)
    names = np.array(exposures.names, object)
    values = table[[name for name in EXPOSURE_COLUMNS if name != "band"]].to_numpy(float)
    shared = {**settings.model_dump(), "instrument": instrument.name, "seed": render.seed}
    if drawn:
        shared |= render.render.model_dump()
    keys = tuple(members)

    def unit(index: int) -> Unit:
        (k, band), chosen = keys[index], members[keys[index]]
        state: dict[str, Any] = {**shared, "tile": tiles[k].name, "band": band}
        if drawn:
            state["exposures"] = digest(values[chosen])
            inputs = render.truth.inputs(*cone(footprints[k]))
        else:
            state["exposures"] = names[chosen].tolist()
            inputs = tuple((exposures.stage, name) for name in names[chosen])
        return Unit(f"{tiles[k].name}-{band}", state, inputs, 1.0 + len(chosen))

    def coordinates() -> Coordinates:
        headers = [header_text(tile.header(pixels, instrument.coadd_scale)) for tile in tiles]
        text = {"description": "FITS header of the WCS, 80-column cards"}
        return {
            "tile": (("tile",), np.array([tile.name for tile in tiles], object), {}),
            "band": (("band",), np.array(instrument.bands, object), {}),
            "tile_id": (("tile",), np.array([tile.id for tile in tiles]), {}),
            "ra": (("tile",), np.array([tile.ra for tile in tiles]), {"units": "deg"}),
            "dec": (("tile",), np.array([tile.dec for tile in tiles]), {"units": "deg"}),
            "header": (("tile",), np.array(headers, object), text),
        }

    mean = np.mean([len(chosen) for chosen in members.values()])
    return ImageProduct(
        f"coadds/{instrument.name}",
        LazyUnits(tuple(f"{tiles[k].name}-{band}" for k, band in keys), unit),
        maker,
        _planes(pixels, psf_side(instrument), "1/nJy2" if drawn else "s"),
        ("tile", "band"),
        (len(tiles), len(instrument.bands)),
        coordinates,
        {"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        bytes_per_unit=pixels**2 * (48 if drawn else 33)
        + int(np.prod(instrument.shape)) * (0 if drawn else 22)
        + (550 << 20),
        # a drizzled exposure seldom covers a whole tile
        seconds_per_unit=pixels**2 * (6e-7 if drawn else 2e-7 + 6e-8 * float(mean)),
    )


def _members(table: pd.DataFrame, tiles: np.ndarray, bands: tuple[str, ...]) -> dict[tuple[int, str], np.ndarray]:
    """Return the rows of the exposures that touch each tile (tiles, 4, 2), by tile and band, in order."""
    e, t = touching_pairs(corners_of(table), tiles)
    code = table["band"].map({band: number for number, band in enumerate(bands)}).to_numpy()[e]
    group = t * len(bands) + code
    order = np.lexsort((e, group))
    limits = np.searchsorted(group[order], np.arange(len(tiles) * len(bands) + 1))
    parts = np.split(e[order], limits[1:-1])
    return {(k // len(bands), bands[k % len(bands)]): part for k, part in enumerate(parts)}


def psf_side(instrument: Instrument) -> int:
    """Return the side of the PSF images of an instrument's coadds, pixels, odd."""
    radius = PSF_RADIUS * max(1.0, instrument.coadd_scale / 0.1)
    return 2 * int(round(radius / instrument.coadd_scale)) + 1


@dataclass(frozen=True)
class DrizzleTile:
    """Makes one tile and band by drizzling its exposures."""

    exposures: ImageProduct
    tiles: tuple[Tile, ...]
    members: dict[tuple[int, str], np.ndarray]
    settings: CoaddSettings
    pixels: int
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages and psf."""
        source: RenderExposure = self.exposures.make  # type: ignore[assignment]
        instrument = source.instrument
        k, b = divmod(index, len(instrument.bands))
        tile, band = self.tiles[k], instrument.bands[b]
        scale = instrument.coadd_scale
        target = WCS(tile.header(self.pixels, scale))
        side = psf_side(instrument)
        sums = Sums((self.pixels, self.pixels), 2, self.settings.pixfrac)
        psf = Sums((side, side), 1, self.settings.pixfrac)
        for i in self.members[k, band]:
            exposure = exposure_of(source.table.iloc[i])
            header = instrument.header(exposure)
            wcs = WCS(header)
            parts = strips(wcs, instrument.shape, target, (self.pixels, self.pixels))
            if parts:
                arrays = self.exposures.load(int(i), ("image", "variance", "dq"))
                sums.add(_planes_of(arrays, parts, instrument, exposure, header, target, source.seed))
                _add_star(psf, instrument, exposure, wcs, tile, side)
        area = np.float32(scale**2)
        return {
            "image": sums.image(0) * area,
            "weight": sums.weight,
            "noise": sums.image(1) * area,
            "nimages": sums.count,
            "psf": psf.image(0) * area,
        }


@dataclass(frozen=True)
class DrawTile:
    """Makes one tile and band from the cadence: the expectation with the effective PSF, and the stack's noise."""

    exposures: ImageProduct
    tiles: tuple[Tile, ...]
    members: dict[tuple[int, str], np.ndarray]
    settings: CoaddSettings
    pixels: int
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages and psf."""
        source: RenderExposure = self.exposures.make  # type: ignore[assignment]
        instrument: Any = source.instrument
        k, b = divmod(index, len(instrument.bands))
        tile, band = self.tiles[k], instrument.bands[b]
        shape = (self.pixels, self.pixels)
        wcs = WCS(tile.header(self.pixels, instrument.coadd_scale))
        bandpass = instrument.bandpass(band)
        chosen = [exposure_of(source.table.iloc[i]) for i in self.members[k, band]]
        to_njy = NJY_ZERO_POINT / bandpass.ab_photons()
        gains = np.array([exposure.exptime for exposure in chosen]) / to_njy
        variances = (np.array([instrument.pixel_noise(exposure) for exposure in chosen]) / gains) ** 2
        corners = corners_of(source.table.iloc[self.members[k, band]])
        polygons = np.stack(wcs.all_world2pix(corners[..., 0].ravel(), corners[..., 1].ravel(), 0, quiet=True), -1)
        layers = stack(polygons.reshape(-1, 4, 2), variances, gains, shape)
        if not layers.shares.any():
            side = psf_side(instrument)
            blank = np.zeros(shape, np.float32)
            return {
                "image": blank,
                "weight": blank,
                "noise": blank,
                "nimages": layers.count,
                "psf": np.zeros((side, side)),
            }
        truth = source.truth.near(*cone(tile.corners(self.settings.grid().side)))
        scene = build_scene(truth, wcs, bandpass, to_njy, instrument.knot_smoothing).scene
        faintest = self.render.truncation / np.sqrt(layers.weight.max())
        psf = instrument.effective_psf(chosen, layers.shares)
        stamps = plan_stamps(scene, psf.edges, shape, faintest, self.render.largest)
        covered = layers.weight > 0
        expected = np.where(covered, draw(scene, psf, shape, stamps, faintest), 0)
        empty = np.where(covered, 1 / np.maximum(layers.weight, np.finfo(np.float32).tiny), 0)
        light = rng(source.seed, "coadds", instrument.name, tile.id, band).standard_normal(shape, dtype=np.float32)
        other = rng(source.seed, "coadds", "noise", instrument.name, tile.id, band).standard_normal(
            shape, dtype=np.float32
        )
        return {
            "image": expected + light * np.sqrt(empty + layers.source * np.maximum(expected, 0)),
            "weight": layers.weight,
            "noise": other * np.sqrt(empty),
            "nimages": layers.count,
            "psf": _star(psf, bandpass, psf_side(instrument)),
        }


def _planes_of(
    arrays: dict[str, np.ndarray],
    parts: list[Strip],
    instrument: Instrument,
    exposure: Exposure,
    header: dict,
    target: WCS,
    seed: int,
) -> Iterator[tuple[list[np.ndarray], np.ndarray, np.ndarray]]:
    """Yield, for each strip, image and noise realisation in nJy/arcsec2, weight and map onto the tile."""
    good = usable(arrays["dq"])
    light = subtract_background(arrays["image"], ~good)
    to_njy = NJY_ZERO_POINT / instrument.bandpass(exposure.band).ab_photons() / exposure.exptime
    identity = ("noise", instrument.name, exposure.visit, exposure.detector)
    wcs = WCS(header)
    for part in parts:
        here = (part.rows, part.columns)
        scale = to_njy / pixel_areas(header, instrument.shape, *here)
        background = instrument.background(exposure, header, *here)
        noise = noise_realisation(
            empty_variance(arrays, background, instrument.detector, here), instrument.shape[1], *here,
            lambda block: rng(seed, "coadds", *identity, block),
        )  # fmt: skip
        weight = np.float32(exposure.exptime) * good[here]
        yield [light[here] * scale, noise * scale], weight, pixel_map(wcs, target, *here)


def subtract_background(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return an exposure (float32, electrons) less its background, estimated from the image itself on a coarse mesh."""
    light = image.astype(np.float32)
    background = sep.Background(light, mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH)
    background.subfrom(light)
    return light


def _star(
    psf: PsfModel,
    bandpass: Bandpass,
    side: int,
    offset: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Return a unit star (side, side) of flat f_nu whose centre is `offset` pixels from the middle."""
    middle = (side - 1) / 2
    scene = Scene(
        x=np.array([middle + offset[0]]),
        y=np.array([middle + offset[1]]),
        key=np.zeros(1, np.uint64),
        owner=np.zeros(1, int),
        kind=np.full(1, POINT),
        matrix=np.zeros((1, 2, 2)),
        smoothing=np.zeros((1, 2, 2)),
        knots=np.zeros(1, int),
        photons=flat_shares(bandpass)[None],
    )
    image = np.zeros((side, side), np.float32)
    draw_wide(image, scene, scene.photons, psf.nodes, psf.grid, np.array([psf.grid.size]))
    return image


def _add_star(psf: Sums, instrument: Instrument, exposure: Exposure, wcs: WCS, tile: Tile, side: int) -> None:
    """Drizzle unit stars, as the exposure sees them as near as it can to the tile's centre, onto the PSF image."""
    ny, nx = instrument.shape
    at = np.array(wcs.all_world2pix(tile.ra, tile.dec, 0, quiet=True), float)
    # a stamp at any roll covers the corners of the PSF image
    half = int(np.ceil(1.5 * side * instrument.coadd_scale / instrument.pixel_scale / 2)) + 2
    column, row = np.rint(np.clip(at, half + 1, [nx - half - 2, ny - half - 2])).astype(int)
    rows, columns = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
    model, bandpass = instrument.psf_at(exposure, column, row), instrument.bandpass(exposure.band)
    area = pixel_areas_at(wcs, float(column), float(row))
    for offset in PSF_PHASES:
        star = _star(model, bandpass, 2 * half + 1, offset)
        ra, dec = wcs.all_pix2world(column + offset[0], row + offset[1], 0)
        target = WCS(tangent_header(float(ra), float(dec), side, instrument.coadd_scale))
        weight = np.full(star.shape, exposure.exptime, np.float32)
        psf.add([([(star / area).astype(np.float32)], weight, pixel_map(wcs, target, rows, columns))])


def pixel_areas_at(wcs: WCS, x: float, y: float) -> float:
    """Return the area, arcsec2, of the pixel at a position."""
    ra, dec = wcs.all_pix2world([x + 0.5, x - 0.5, x, x], [y, y, y + 0.5, y - 0.5], 0)
    east = ((ra[[0, 2]] - ra[[1, 3]] + 180) % 360 - 180) * np.cos(np.radians(dec.mean()))
    north = dec[[0, 2]] - dec[[1, 3]]
    return float(abs(east[0] * north[1] - east[1] * north[0]) * 3600**2)


def _planes(pixels: int, psf: int, weight_unit: str) -> tuple[Variable, ...]:
    shape, axes = (pixels, pixels), ("y", "x")
    return (
        Variable("image", "float32", shape, axes, {"units": "nJy", "long_name": "flux of a pixel"}),
        Variable("weight", "float32", shape, axes, {"units": weight_unit, "long_name": "sum of weights"}),
        Variable(
            "noise",
            "float32",
            shape,
            axes,
            {"units": "nJy", "long_name": "noise realisation with the image's correlations"},
        ),
        Variable("nimages", "uint8", shape, axes, {"long_name": "number of exposures"}),
        Variable("psf", "float32", (psf, psf), ("v", "u"), {"long_name": "unit star at the tile's centre, flat f_nu"}),
    )
