"""Differences: Rubin's tiles less Roman's, blurred to match, and what is left of every bright object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.kernels.coadding.pixel_map import PixelMap, pixel_map
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.kernels.measurement.difference import Matched, blurred, dipoles, match, matching_kernel
from romandask.model.settings import DifferenceSettings
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.units import Unit
from romandask.stages.coadds.tile_maker import TileMaker, tile_maker
from romandask.stages.detections.tile_bands import TileBands
from romandask.stages.exposures import RenderExposure
from romandask.storage.arrays import Variable

ROWS = 128
"""Rows of a tile that the template is blurred for at a time."""
MOST = 600
"""Objects at most, the brightest, around which the template is matched."""


def differences(
    templates: ImageProduct, coadds: ImageProduct, detections: ImageProduct, settings: DifferenceSettings
) -> ImageProduct:
    """Return the lazy differences of a survey's tiles and those of a sharper one, a unit a tile, dims (tile, y, x).

    Arrays: `difference` (nJy), `template`, the other survey's tile as this one would have it, and `rms` of a pixel of
    the difference, 0 for no data. Beside each tile's is its table `residuals` (schema: catalogs/residuals.yaml).

    Parameters
    ----------
    templates, coadds : what `coadds()` returned for the sharper survey, and for this one, of the same tiles
    detections : of this survey
    """
    maker = DifferTile(templates, coadds, detections, settings)
    sharp, blunt = maker.sharp, maker.blunt
    name, pixels = blunt.source.instrument.name, blunt.maker.pixels

    def unit(k: int) -> Unit:
        tile = blunt.maker.tiles[k].name
        images = (templates.stage, f"{tile}-{settings.template}"), (coadds.stage, f"{tile}-{settings.science}")
        return Unit(tile, settings.model_dump(), (*images, (detections.stage, tile)))

    shape, axes = (pixels, pixels), ("y", "x")
    text = {
        "difference": f"{settings.science} less the matched {settings.template}",
        "template": f"{settings.template}, matched to {settings.science}",
        "rms": "of the difference; 0 for no data",
    }
    ratio = (blunt.source.instrument.coadd_scale / sharp.source.instrument.coadd_scale) ** 2
    return ImageProduct(
        stage=f"differences/{name}",
        units=tuple(unit(k) for k in range(len(blunt.maker.tiles))),
        make=maker,
        variables=tuple(
            Variable(key, "float32", shape, axes, {"units": "nJy", "long_name": value}) for key, value in text.items()
        ),
        axes=("tile",),
        lengths=(len(blunt.maker.tiles),),
        coordinates=lambda: {key: value for key, value in coadds.coordinates().items() if value[0] == ("tile",)},
        attributes={"survey": name, "pixel_scale": blunt.source.instrument.coadd_scale},
        # planes of the tile, those of the basis among them; a strip of the sharper one and its transforms
        bytes_per_unit=int(pixels**2 * 75 + pixels * ratio * (ROWS + 200) * 30 + (280 << 20)),
        seconds_per_unit=pixels**2 * ratio * 4e-7,
        tables={"residuals": schema("residuals")},
    )


@dataclass(frozen=True)
class Side:
    """The tiles of one survey."""

    product: ImageProduct
    band: str

    @property
    def maker(self) -> TileMaker:
        """What makes them."""
        return tile_maker(self.product)

    @property
    def source(self) -> RenderExposure:
        """What makes their exposures."""
        return self.maker.source

    def bands(self, tile: int) -> TileBands:
        """Return the bands of a tile."""
        return TileBands(self.product, self.source.instrument, tile)

    def wcs(self, tile: int) -> WCS:
        """Return the WCS of a tile."""
        return self.maker.wcs(tile)


@dataclass(frozen=True)
class DifferTile:
    """Makes the difference of one tile."""

    templates: ImageProduct
    coadds: ImageProduct
    detections: ImageProduct
    settings: DifferenceSettings

    @property
    def sharp(self) -> Side:
        """The survey of the template."""
        return Side(self.templates, self.settings.template)

    @property
    def blunt(self) -> Side:
        """The survey it is taken from."""
        return Side(self.coadds, self.settings.science)

    def __call__(self, index: int) -> dict[str, np.ndarray | pd.DataFrame]:
        """Return difference, template and rms of a tile, and the table of residuals."""
        layer = self.blunt.bands(index).layer(self.settings.science)
        template, bad = self.template(index, "image")
        error = np.where(layer.mask | bad, np.float32(0), layer.error)
        objects = self.detections.load(index, ("objects",))["objects"]
        bright = self.bright(objects)
        x, y = (bright[name].to_numpy(float) for name in ("x", "y"))
        found = match(layer.image, template, error, x[:MOST], y[:MOST])
        matched = found.image(template)
        difference = np.where(error > 0, layer.image - matched - found.sky(), 0)
        left = dipoles(difference, matched, error, x, y)
        rms = self.rms(index, found, error)
        return {
            "difference": difference.astype(np.float32),
            "template": matched,
            "rms": rms,
            "residuals": residual_table(bright, left, self.settings.science),
        }

    def rms(self, index: int, found: Matched, error: np.ndarray) -> np.ndarray:
        """Return the rms of a pixel of the difference: noise of both, the template's as it is matched."""
        noise, _ = self.template(index, "noise")
        spread = found.image(noise)[error > 0]
        extra = 1.4826 * np.median(np.abs(spread - np.median(spread))) if len(spread) else 0.0
        return np.where(error > 0, np.hypot(error, np.float32(extra)), 0).astype(np.float32)

    def bright(self, objects: pd.DataFrame) -> pd.DataFrame:
        """Return unflagged objects, or flagged for a neighbour alone, of enough signal; the brightest first."""
        flux, error = (objects[f"{self.settings.science}_psf{name}"].to_numpy(float) for name in ("Flux", "FluxErr"))
        with np.errstate(invalid="ignore"):
            chosen = (objects["flags"].to_numpy() & ~3 == 0) & (flux > self.settings.min_snr * error)
        return objects[chosen].iloc[np.argsort(-flux[chosen], kind="stable")]

    def template(self, index: int, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return an array of the sharper tile as this survey's PSF has it, and where it has no data (ny, nx)."""
        sharp, blunt = self.sharp.bands(index), self.blunt.bands(index)
        fine, coarse = sharp.instrument.coadd_scale, blunt.instrument.coadd_scale
        psfs = (
            side.arrays(band, ("psf",))["psf"]
            for side, band in ((sharp, self.settings.template), (blunt, self.settings.science))
        )
        sharp_psf, blunt_psf = psfs
        side, pixels = self.sharp.maker.pixels, self.blunt.maker.pixels
        if not (sharp_psf.any() and blunt_psf.any()):
            return np.zeros((pixels, pixels), np.float32), np.ones((pixels, pixels), bool)
        kernel = matching_kernel(sharp_psf, fine, blunt_psf, coarse)
        out, bad = np.empty((pixels, pixels), np.float32), np.empty((pixels, pixels), bool)
        for first in range(0, pixels, ROWS):
            rows = slice(first, min(first + ROWS, pixels))
            onto = pixel_map(self.blunt.wcs(index), self.sharp.wcs(index), rows, slice(0, pixels))

            def read(*window: slice) -> np.ndarray:
                return sharp.arrays(self.settings.template, (name,), window)[name]

            out[rows] = blurred(read, (side, side), kernel, onto, (coarse / fine) ** 2)
            bad[rows] = self._bad(sharp, onto, kernel.shape[0] // 4)
        return out, bad

    def _bad(self, sharp: TileBands, onto: PixelMap, reach: int) -> np.ndarray:
        """True where the template has pixels without data, or saturated, near the middle of its kernel."""
        places = np.rint(onto.dense()).astype(int)
        side = self.sharp.maker.pixels
        low = [max(int(places[..., k].min()) - reach, 0) for k in (1, 0)]
        high = [min(int(places[..., k].max()) + reach + 1, side) for k in (1, 0)]
        window = slice(low[0], high[0]), slice(low[1], high[1])
        planes = sharp.arrays(self.settings.template, ("weight", "dq"), window)
        empty = (planes["weight"] <= 0) | ((planes["dq"] & SATURATED) > 0)
        # sums over a square from cumulative ones
        total = np.pad(empty.astype(np.int32).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        y, x = places[..., 1] - low[0], places[..., 0] - low[1]
        y0, x0 = np.clip(y - reach, 0, len(empty)), np.clip(x - reach, 0, empty.shape[1])
        y1, x1 = np.clip(y + reach + 1, 0, len(empty)), np.clip(x + reach + 1, 0, empty.shape[1])
        outside = (places < 0).any(axis=-1) | (places >= side).any(axis=-1)
        return (total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0] > 0) | outside


def residual_table(objects: pd.DataFrame, left: np.ndarray, band: str) -> pd.DataFrame:
    """Return what is left of objects (schema: catalogs/residuals.yaml); those with no fit are left out."""
    names = ("share", "dx", "dy", "shareErr", "dxErr", "dyErr")
    columns = {name: objects[name].to_numpy() for name in ("objectId", "coord_ra", "coord_dec")}
    flux = {name: objects[f"{band}_{name}"].to_numpy() for name in ("psfFlux", "psfFluxErr")}
    frame = pd.DataFrame({**columns, **flux, **dict(zip(names, left.T, strict=True))})
    return frame[np.isfinite(left).all(axis=1)].reset_index(drop=True)
