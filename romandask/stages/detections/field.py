"""Fields: images of one area of the sky in one or more bands, from which objects are detected and measured.

A field has, in each band, an image, its weight, a realisation of its noise and its PSF. Photometry holds one band in
memory at a time; the detection image is made from small windows of all bands.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.kernels.measurement import psf_fit
from romandask.kernels.measurement.measurement_image import (
    MeasurementImage,
    errors,
    median,
    noise_ratios,
    rms_of,
    weighted_mean,
)
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.products.memory import release_free_memory
from romandask.products.mosaic import Mosaic
from romandask.stages.coadds.tile_maker import Coadds
from romandask.storage.arrays import chunk_side

Window = tuple[slice, ...]
"""Rows and columns of an image."""
WHOLE: Window = (slice(None), slice(None))
"""Window that covers an image."""
_CHUNKS = 3
"""Width, in chunks, of the windows of all bands that are in memory while the detection image is made."""


@dataclass(frozen=True, kw_only=True)
class Field(ABC):
    """Images of one area of the sky in one or more bands, on one pixel grid."""

    bands: tuple[str, ...]
    """Bands in which objects are measured."""
    detection_bands: tuple[str, ...]
    """Bands in which objects are detected."""
    method: Literal["median", "peaks"]
    """Detection method. `median`: connected pixels of the median of the bands, as in Source Extractor. `peaks`: peaks
    of the weighted mean of the bands, smoothed with its PSF."""
    pixel_scale: float
    """Pixel scale, arcsec."""
    aperture: float
    """Radius of the circular apertures, arcsec."""
    electrons_per_njy: Mapping[str, float]
    """Electrons per nJy and unit exposure, by band. The unit is a second, or one exposure if `nimages` gives the
    exposure of a pixel. 0 leaves out the Poisson noise of the sources."""
    weight_is_exposure_time: bool
    """True if the weight of a pixel is proportional to its exposure time; False if the array `nimages` gives the
    exposure."""

    @abstractmethod
    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return arrays of a band, by name.

        Parameters
        ----------
        band : str
        names : tuple of str
            `image` (nJy), `weight` (0 for no data), `noise` (one realisation, nJy), `dq` (data quality), `nimages`
            (number of exposures) or `psf` (unit flux).
        window : tuple of slice
            Rows and columns to return. `psf` is always returned whole.
        """

    def measurement(self, band: str) -> MeasurementImage:
        """Return the measurement image of a band.

        Three images of the field are in memory while it is made, and two afterwards.
        """
        noise, weight = self.arrays(band, ("noise", "weight")).values()
        rms = rms_of(noise, weight)
        error, mask = errors(weight, rms)
        ratios = noise_ratios(noise, error, mask)
        psf = self.arrays(band, ("psf",))["psf"]
        psf_ratio = psf_fit.scatter(noise, psf, error)
        # make room for the image
        del noise, weight
        release_free_memory()
        exposures = None if self.weight_is_exposure_time else self.arrays(band, ("nimages",))["nimages"]
        image = self.arrays(band, ("image",))["image"]
        return MeasurementImage(
            image=image,
            error=error,
            mask=mask,
            aperture_ratios=ratios,
            psf=psf,
            psf_ratio=psf_ratio,
            electrons_per_flux=self.electrons_per_njy[band],
            rms=rms,
            exposure_map=exposures,
        )

    def saturated(self, band: str) -> np.ndarray:
        """Return True, (ny, nx), for the saturated pixels of a band."""
        return (self.arrays(band, ("dq",))["dq"] & SATURATED) > 0

    def detection(self) -> MeasurementImage:
        """Return the detection image: the median of the detection bands, or their inverse-variance weighted mean."""
        bands = self.detection_bands
        median_weights, rms = [], []
        for band in bands:
            noise, weight = self.arrays(band, ("noise", "weight")).values()
            rms.append(rms_of(noise, weight))
            sampled = weight[::8, ::8]
            median_weights.append(float(np.median(sampled[sampled > 0])) if (sampled > 0).any() else 0.0)
            shape = weight.shape
            del noise, weight, sampled
        image, noise, total = (np.empty(shape, np.float32) for _ in range(3))
        for window in _windows(shape):
            planes = [self.arrays(band, ("image", "noise", "weight"), window) for band in bands]
            weights = [arrays["weight"] for arrays in planes]
            if self.method == "median":
                image[window], noise[window] = (
                    median([arrays[name] for arrays in planes], weights) for name in ("image", "noise")
                )
                # each weight in units of the median weight of its band
                total[window] = sum(w / m for w, m in zip(weights, median_weights, strict=True) if m > 0) / len(bands)
            else:
                image[window], total[window] = weighted_mean([arrays["image"] for arrays in planes], weights, rms)
                noise[window], _ = weighted_mean([arrays["noise"] for arrays in planes], weights, rms)
        error, mask = errors(total, rms_of(noise, total))
        psf = np.mean([self.arrays(band, ("psf",))["psf"] for band in bands], axis=0)
        return MeasurementImage(
            image=image,
            error=error,
            mask=mask,
            aperture_ratios=noise_ratios(noise, error, mask),
            psf=psf,
            psf_ratio=psf_fit.scatter(noise, psf, error),
        )


@dataclass(frozen=True, kw_only=True)
class TileField(Field):
    """One tile of a survey's coadds as a field."""

    coadds: Coadds
    """Coadds of the survey."""
    tile: int
    """Index of the tile."""
    images: dict[str, Mosaic] = field(default_factory=dict)
    """Readers of windows of the tile by band. They read the store, or the memory where a patch is not stored and was
    made."""

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return arrays of a band, by name (see `Field.arrays`); `noise` is the first realisation."""
        image = self.images.setdefault(band, self.coadds.tile_image(self.tile, band))
        arrays = {}
        for name in names:
            if name == "psf":
                arrays[name] = self.coadds.tile_psf(self.tile, band)
            elif name == "noise":
                arrays[name] = image(name, (slice(0, 1), *window))[0]
            else:
                arrays[name] = image(name, window)
        return arrays


@dataclass(frozen=True, kw_only=True)
class ArrayField(Field):
    """Images in memory, from any program."""

    images: Mapping[str, Mapping[str, np.ndarray]]
    """Arrays by band and name (see `Field.arrays`). Without `dq`, no pixel is saturated."""

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return arrays of a band, by name (see `Field.arrays`)."""
        images = self.images[band]
        no_flags = np.zeros(images["image"].shape, np.uint8)
        arrays = {name: images.get(name, no_flags) if name == "dq" else images[name] for name in names}
        # copies, because weights are overwritten in place
        return {name: array if name == "psf" else array[window].copy() for name, array in arrays.items()}


def tile_field(coadds: Coadds, tile: int) -> TileField:
    """Return a tile of a survey's coadds as a field, with the bands and the detection method of its instrument.

    Parameters
    ----------
    coadds : Coadds
    tile : int
        Index of the tile.
    """
    instrument = coadds.instrument
    drizzled = instrument.coadd == "drizzle"
    electrons = {band: instrument.bandpass(band).ab_photons() / NJY_ZERO_POINT for band in instrument.bands}
    if not drizzled:
        electrons = {band: rate * instrument.visit_seconds for band, rate in electrons.items()}
    return TileField(
        bands=instrument.bands,
        detection_bands=instrument.detection_bands or instrument.bands,
        method=instrument.detection,
        pixel_scale=instrument.coadd_scale,
        aperture=instrument.aperture,
        electrons_per_njy=electrons,
        weight_is_exposure_time=drizzled,
        coadds=coadds,
        tile=tile,
    )


def _windows(shape: tuple[int, ...]) -> Iterator[Window]:
    """Yield windows that cover an image (ny, nx) and consist of whole chunks, so that no chunk is decoded twice."""
    height, width = chunk_side(shape[0]), _CHUNKS * chunk_side(shape[1])
    for top in range(0, shape[0], height):
        for left in range(0, shape[1], width):
            yield slice(top, top + height), slice(left, left + width)
