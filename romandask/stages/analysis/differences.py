"""Differences: the tiles of one survey minus those of a sharper survey, matched in PSF, and residuals of objects.

By default the science band is Rubin's y and the template band Roman's Y106.
"""

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

STRIP_ROWS = 128
"""Number of rows of a tile for which the template is blurred at a time."""
MAX_MATCHED_OBJECTS = 600
"""Largest number of objects, the brightest, on which the template is matched to the science image."""


def differences(
    templates: Coadds, coadds: Coadds, detections: Detections, settings: DifferenceSettings
) -> ImageProduct:
    """Return the lazy differences of a survey's tiles and those of a sharper survey, one unit per tile.

    Parameters
    ----------
    templates : Coadds
        Coadds of the sharper survey.
    coadds : Coadds
        Coadds of this survey, with the same tiles.
    detections : Detections
        Detections of this survey.
    settings : DifferenceSettings
        Section `differences` of the pipeline.

    Returns
    -------
    ImageProduct, dims (tile, y, x)
        Arrays, in nJy: `difference`, `template` (the sharper tile on the pixels and with the PSF and flux scale of
        this survey) and `rms` (of a pixel of the difference; 0 for no data). Each tile also has a table `residuals`
        (schema: catalogs/residuals.yaml).
    """
    name, pixels, scale = coadds.instrument.name, coadds.pixels, coadds.instrument.coadd_scale

    def unit(k: int) -> Unit:
        tile = coadds.tiles[k].name
        bands = (templates, settings.template), (coadds, settings.science)
        images = ((each.stage, each.names[n]) for each, band in bands for n in each.units_of(k, band))
        return Unit(tile, settings.model_dump(), (*images, (detections.stage, tile)))

    long_names = {
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
            for key, value in long_names.items()
        ),
        axes=("tile",),
        lengths=(len(coadds.tiles),),
        coordinates=lambda: {
            key: value for key, value in coadds.product.coordinates().items() if value[0] == ("tile",)
        },
        attributes={"survey": name, "pixel_scale": scale},
        # images of the tile, those of the basis kernels included; a strip of the sharper tile and its transforms
        bytes_per_unit=int(pixels**2 * 75 + pixels * ratio * (STRIP_ROWS + 200) * 30 + (280 << 20)),
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
        """Return `difference`, `template` and `rms` (ny, nx), and the table `residuals`, of a tile."""
        science = tile_field(self.coadds, index).measurement(self.settings.science)
        template, unusable = self.template(index, "image")
        error = np.where(science.mask | unusable, np.float32(0), science.error)
        bright = self.bright(self.detections.objects(index))
        x, y = (bright[name].to_numpy(float) for name in ("x", "y"))
        fit = match(science.image, template, error, x[:MAX_MATCHED_OBJECTS], y[:MAX_MATCHED_OBJECTS])
        matched = fit.image(template)
        difference = np.where(error > 0, science.image - matched - fit.sky(), 0)
        residuals = dipoles(difference, matched, error, x, y)
        return {
            "difference": difference.astype(np.float32),
            "template": matched,
            "rms": self.rms(index, fit, error),
            "residuals": residual_table(bright, residuals, self.settings.science),
        }

    def rms(self, index: int, fit: Matched, error: np.ndarray) -> np.ndarray:
        """Return the rms of each pixel of the difference (ny, nx), nJy: noise of the science image and the template.

        Parameters
        ----------
        index : int
            Index of the tile.
        fit : Matched
            Fit of the template, by which the noise of the template is transformed.
        error : ndarray, shape (ny, nx)
            Rms of the science image; 0 for no data.
        """
        noise, _ = self.template(index, "noise")
        matched_noise = fit.image(noise)[error > 0]
        template_rms = (
            1.4826 * np.median(np.abs(matched_noise - np.median(matched_noise))) if len(matched_noise) else 0.0
        )
        return np.where(error > 0, np.hypot(error, np.float32(template_rms)), 0).astype(np.float32)

    def bright(self, objects: pd.DataFrame) -> pd.DataFrame:
        """Return the objects above `differences.min_snr`, brightest first; only the lowest two flag bits may be set."""
        flux, error = (objects[f"{self.settings.science}_psf{name}"].to_numpy(float) for name in ("Flux", "FluxErr"))
        with np.errstate(invalid="ignore"):
            selected = (objects["flags"].to_numpy() & ~3 == 0) & (flux > self.settings.min_snr * error)
        return objects[selected].iloc[np.argsort(-flux[selected], kind="stable")]

    def template(self, index: int, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return an array of the sharper tile on the pixels, and with the PSF, of this survey.

        Parameters
        ----------
        index : int
            Index of the tile.
        name : str
            Name of the array, `image` or `noise`.

        Returns
        -------
        values : ndarray, shape (ny, nx), float32
        unusable : ndarray, shape (ny, nx), bool
            True where the sharper tile has no data, or is saturated, near the pixel.
        """
        sharp, blunt = tile_field(self.templates, index), tile_field(self.coadds, index)
        fine, coarse = sharp.pixel_scale, blunt.pixel_scale
        sharp_psf = sharp.arrays(self.settings.template, ("psf",))["psf"]
        blunt_psf = blunt.arrays(self.settings.science, ("psf",))["psf"]
        sharp_pixels, pixels = self.templates.pixels, self.coadds.pixels
        if not (sharp_psf.any() and blunt_psf.any()):
            return np.zeros((pixels, pixels), np.float32), np.ones((pixels, pixels), bool)
        kernel = matching_kernel(sharp_psf, fine, blunt_psf, coarse)
        values, unusable = np.empty((pixels, pixels), np.float32), np.empty((pixels, pixels), bool)
        for first in range(0, pixels, STRIP_ROWS):
            rows = slice(first, min(first + STRIP_ROWS, pixels))
            onto = pixel_map(self.coadds.wcs(index), self.templates.wcs(index), rows, slice(0, pixels))

            def read(*window: slice) -> np.ndarray:
                return sharp.arrays(self.settings.template, (name,), window)[name]

            values[rows] = blurred(read, (sharp_pixels, sharp_pixels), kernel, onto, (coarse / fine) ** 2)
            unusable[rows] = self._unusable(sharp, onto, kernel.shape[0] // 4)
        return values, unusable

    def _unusable(self, sharp: Field, onto: PixelMap, reach: int) -> np.ndarray:
        """Return True for pixels outside the sharper tile or within `reach` of its empty or saturated pixels."""
        nearest = np.rint(onto.dense()).astype(int)
        side = self.templates.pixels
        low = [max(int(nearest[..., k].min()) - reach, 0) for k in (1, 0)]
        high = [min(int(nearest[..., k].max()) + reach + 1, side) for k in (1, 0)]
        window = slice(low[0], high[0]), slice(low[1], high[1])
        planes = sharp.arrays(self.settings.template, ("weight", "dq"), window)
        bad = (planes["weight"] <= 0) | ((planes["dq"] & SATURATED) > 0)
        # the number of bad pixels in a square, from cumulative sums
        total = np.pad(bad.astype(np.int32).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        y, x = nearest[..., 1] - low[0], nearest[..., 0] - low[1]
        y0, x0 = np.clip(y - reach, 0, len(bad)), np.clip(x - reach, 0, bad.shape[1])
        y1, x1 = np.clip(y + reach + 1, 0, len(bad)), np.clip(x + reach + 1, 0, bad.shape[1])
        outside = (nearest < 0).any(axis=-1) | (nearest >= side).any(axis=-1)
        return (total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0] > 0) | outside


def residual_table(objects: pd.DataFrame, residuals: np.ndarray, band: str) -> pd.DataFrame:
    """Return the residuals of objects in the difference (schema: catalogs/residuals.yaml).

    Parameters
    ----------
    objects : DataFrame
        The n objects (schema: catalogs/objects.yaml).
    residuals : ndarray, shape (n, 6)
        Fits as `kernels.measurement.difference.dipoles` returns them; objects with NaN are left out.
    band : str
        Science band.
    """
    names = ("share", "dx", "dy", "shareErr", "dxErr", "dyErr")
    columns = {name: objects[name].to_numpy() for name in ("objectId", "coord_ra", "coord_dec")}
    flux = {name: objects[f"{band}_{name}"].to_numpy() for name in ("psfFlux", "psfFluxErr")}
    frame = pd.DataFrame({**columns, **flux, **dict(zip(names, residuals.T, strict=True))})
    return frame[np.isfinite(residuals).all(axis=1)].reset_index(drop=True)


def _template_survey(context: SurveyContext) -> str | None:
    """Return the survey that has the template band, or None."""
    band = context.pipeline.differences.template
    return next((name for name, instrument in context.instruments.items() if band in instrument.bands), None)


def science_survey(context: SurveyContext) -> str:
    """Return the survey that has the science band, from which the template is subtracted.

    Raises
    ------
    UserError
        If no survey has the band.
    """
    settings = context.pipeline.differences
    for name, instrument in context.instruments.items():
        if settings.science in instrument.bands:
            return name
    raise UserError(f"difference images need the bands {settings.template} and {settings.science}")


def has_differences(context: SurveyContext, survey: str) -> bool:
    """Return whether a survey has the science band and any survey the template band (the `exists` of the stage)."""
    bands = context.instruments[survey].bands
    return context.pipeline.differences.science in bands and _template_survey(context) is not None


def build_differences(context: SurveyContext, survey: str) -> ImageProduct:
    """Return the lazy difference images of a survey (the `build` of the stage).

    Raises
    ------
    UserError
        If the pipeline does not have both bands.
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
    summary="A band of one survey (Rubin's y) minus a band of a sharper survey (Roman's Y106) matched to its PSF, and "
    "the residual of each bright object.",
    shrink_with="lower coadds.pixels",
    tables={"residuals": "differences/<survey>_residuals/"},
)
