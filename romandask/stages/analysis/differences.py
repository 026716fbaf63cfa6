"""Differences: Rubin's tiles less Roman's, blurred to match, and what is left of every bright object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.kernels.coadding.pixel_map import PixelMap, pixel_map
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.kernels.measurement.difference import Matched, blurred, dipoles, match, matching_kernel
from romandask.model.errors import UserError
from romandask.model.settings import DifferenceSettings
from romandask.products.images import ImageProduct
from romandask.products.schemas import schema
from romandask.products.units import Unit
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.detections.detections import Detections
from romandask.stages.detections.field import Field, tile_field
from romandask.stages.stage import Stage, SurveyContext
from romandask.storage.arrays import Variable

ROWS = 128
"""Rows of a tile that the template is blurred for at a time."""
MOST = 600
"""Objects at most, the brightest, around which the template is matched."""


def differences(
    templates: Coadds, coadds: Coadds, detections: Detections, settings: DifferenceSettings
) -> ImageProduct:
    """Return the lazy differences of a survey's tiles and those of a sharper one, a unit a tile, dims (tile, y, x).

    Arrays: `difference` (nJy), `template`, the other survey's tile as this one would have it, and `rms` of a pixel of
    the difference, 0 for no data. Beside each tile's is its table `residuals` (schema: catalogs/residuals.yaml).

    Parameters
    ----------
    templates, coadds : Coadds
        Of the sharper survey and of this one, of the same tiles.
    detections : Detections
        Of this survey.
    settings : DifferenceSettings
    """
    name, pixels, scale = coadds.instrument.name, coadds.pixels, coadds.instrument.coadd_scale

    def unit(k: int) -> Unit:
        tile = coadds.tiles[k].name
        images = (templates.stage, f"{tile}-{settings.template}"), (coadds.stage, f"{tile}-{settings.science}")
        return Unit(tile, settings.model_dump(), (*images, (detections.stage, tile)))

    text = {
        "difference": f"{settings.science} less the matched {settings.template}",
        "template": f"{settings.template}, matched to {settings.science}",
        "rms": "of the difference; 0 for no data",
    }
    ratio = (scale / templates.instrument.coadd_scale) ** 2
    return ImageProduct(
        stage=f"differences/{name}",
        units=tuple(unit(k) for k in range(len(coadds.tiles))),
        make=DifferTile(templates, coadds, detections, settings),
        variables=tuple(
            Variable(key, "float32", (pixels, pixels), ("y", "x"), {"units": "nJy", "long_name": value})
            for key, value in text.items()
        ),
        axes=("tile",),
        lengths=(len(coadds.tiles),),
        coordinates=lambda: {
            key: value for key, value in coadds.product.coordinates().items() if value[0] == ("tile",)
        },
        attributes={"survey": name, "pixel_scale": scale},
        # planes of the tile, those of the basis among them; a strip of the sharper one and its transforms
        bytes_per_unit=int(pixels**2 * 75 + pixels * ratio * (ROWS + 200) * 30 + (280 << 20)),
        seconds_per_unit=pixels**2 * ratio * 4e-7,
        tables={"residuals": schema("residuals")},
    )


@dataclass(frozen=True)
class DifferTile:
    """Makes the difference of one tile."""

    templates: Coadds
    coadds: Coadds
    detections: Detections
    settings: DifferenceSettings

    def __call__(self, index: int) -> dict[str, np.ndarray | pd.DataFrame]:
        """Return difference, template and rms of a tile, and the table of residuals."""
        science = tile_field(self.coadds, index).measurement(self.settings.science)
        template, bad = self.template(index, "image")
        error = np.where(science.mask | bad, np.float32(0), science.error)
        bright = self.bright(self.detections.objects(index))
        x, y = (bright[name].to_numpy(float) for name in ("x", "y"))
        found = match(science.image, template, error, x[:MOST], y[:MOST])
        matched = found.image(template)
        difference = np.where(error > 0, science.image - matched - found.sky(), 0)
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
        sharp, blunt = tile_field(self.templates, index), tile_field(self.coadds, index)
        fine, coarse = sharp.pixel_scale, blunt.pixel_scale
        psfs = (
            side.arrays(band, ("psf",))["psf"]
            for side, band in ((sharp, self.settings.template), (blunt, self.settings.science))
        )
        sharp_psf, blunt_psf = psfs
        side, pixels = self.templates.pixels, self.coadds.pixels
        if not (sharp_psf.any() and blunt_psf.any()):
            return np.zeros((pixels, pixels), np.float32), np.ones((pixels, pixels), bool)
        kernel = matching_kernel(sharp_psf, fine, blunt_psf, coarse)
        out, bad = np.empty((pixels, pixels), np.float32), np.empty((pixels, pixels), bool)
        for first in range(0, pixels, ROWS):
            rows = slice(first, min(first + ROWS, pixels))
            onto = pixel_map(self.coadds.wcs(index), self.templates.wcs(index), rows, slice(0, pixels))

            def read(*window: slice) -> np.ndarray:
                return sharp.arrays(self.settings.template, (name,), window)[name]

            out[rows] = blurred(read, (side, side), kernel, onto, (coarse / fine) ** 2)
            bad[rows] = self._bad(sharp, onto, kernel.shape[0] // 4)
        return out, bad

    def _bad(self, sharp: Field, onto: PixelMap, reach: int) -> np.ndarray:
        """True where the template has pixels without data, or saturated, near the middle of its kernel."""
        places = np.rint(onto.dense()).astype(int)
        side = self.templates.pixels
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


def _template_survey(context: SurveyContext) -> str | None:
    """Return the survey that has the template's band; None where none has."""
    band = context.pipeline.differences.template
    return next((name for name, one in context.instruments.items() if band in one.bands), None)


def has_differences(context: SurveyContext, survey: str) -> bool:
    """Return whether a survey has the science band, and one the template's."""
    bands = context.instruments[survey].bands
    return context.pipeline.differences.science in bands and _template_survey(context) is not None


def build_differences(context: SurveyContext, survey: str) -> ImageProduct:
    """Return the lazy difference images of a survey's coadds and those of the template's survey.

    Raises
    ------
    UserError
        If the survey does not have both bands.
    """
    settings, template = context.pipeline.differences, _template_survey(context)
    if template is None or not has_differences(context, survey):
        raise UserError(f"difference images need the bands {settings.template} and {settings.science}")
    coadds = context.output(f"coadds/{template}"), context.output(f"coadds/{survey}")
    return differences(*coadds, context.output(f"detections/{survey}"), settings)


DIFFERENCES = Stage(
    name="differences",
    per_survey=True,
    build=build_differences,
    exists=has_differences,
    reads=("coadds/*", "detections"),
    units_known_after=("pointings/*", "truth/ingested"),
    unit="tile",
    summary="A band of one survey (Rubin's y) less a band of a sharper one (Roman's Y106), matched to its PSF, and "
    "what is left of bright objects.",
    shrink_with="lower coadds.pixels",
    tables={"residuals": "differences/<survey>_residuals/"},
)
