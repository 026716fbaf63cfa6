"""Stored images described as observations: the exposures they are made of, their band and their footprint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.exposures.exposures import Exposures
from romandask.survey import Survey


@dataclass(frozen=True)
class Observation:
    """One image: an exposure, or one tile in one band."""

    exposures: pd.DataFrame
    """Rows of the pointings of the exposures that the image is made of."""
    band: str
    corners: np.ndarray
    """Corners of the image, shape (4, 2): right ascension and declination, degrees."""


@dataclass(frozen=True, kw_only=True)
class ObservedImages:
    """The exposures or the coadds of one instrument, as archives describe them."""

    images: Exposures | Coadds
    """The images."""
    calib_level: int
    """Calibration level of ObsCore: 2 for exposures, 3 for coadds."""
    unit: str
    """Unit of the pixel values."""
    pixel_scale: float
    """Pixel scale, arcsec."""
    observation: Callable[[int], Observation]
    """Returns the observation of an image."""
    psf_fwhm: Callable[[int], float]
    """Returns the FWHM of the PSF of an image, arcsec; NaN if it is unknown."""

    stored: Callable[[], list[int]]
    """Returns the indices of the stored images."""


def observed_images(survey: Survey) -> list[ObservedImages]:
    """Return the exposures, if they are made, and the coadds of each instrument of a survey."""
    observed = []
    for name, instrument in survey.instruments.items():
        if instrument.coadd != "draw":
            observed.append(_exposures(survey.output(f"exposures/{name}")))
        observed.append(_coadds(survey.output(f"coadds/{name}")))
    return observed


def _exposures(exposures: Exposures) -> ObservedImages:
    def observation(index: int) -> Observation:
        row = exposures.table.iloc[[index]]
        return Observation(row, str(exposures.image_bands[index]), exposures.footprints[index])

    return ObservedImages(
        images=exposures,
        calib_level=2,
        unit="electron",
        pixel_scale=exposures.instrument.pixel_scale,
        observation=observation,
        # the PSF of an exposure is not stored, and drawing it takes long
        psf_fwhm=lambda index: np.nan,
        stored=lambda: [index for index in range(len(exposures.names)) if exposures.has(index)],
    )


def _coadds(coadds: Coadds) -> ObservedImages:
    scale, pointings = coadds.instrument.coadd_scale, coadds.exposures.table

    def observation(index: int) -> Observation:
        tile, band = coadds.image_place(index)
        return Observation(pointings.iloc[coadds.tile_members(tile, band)], band, coadds.footprints[index])

    def psf_fwhm(index: int) -> float:
        return _fwhm_pixels(coadds.tile_psf(*coadds.image_place(index))) * scale

    def stored() -> list[int]:
        return [index for index in range(len(coadds.image_names)) if coadds.has_tile(*coadds.image_place(index))]

    return ObservedImages(
        images=coadds,
        calib_level=3,
        unit="nJy",
        pixel_scale=scale,
        observation=observation,
        psf_fwhm=psf_fwhm,
        stored=stored,
    )


def _fwhm_pixels(psf: np.ndarray) -> float:
    """Return the diameter, pixels, of the circle with the area above half the peak; NaN if the image is empty."""
    return float(2 * np.sqrt((psf > psf.max() / 2).sum() / np.pi)) if psf.max() > 0 else np.nan
