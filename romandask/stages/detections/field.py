"""Fields: images of one piece of sky in some bands, from a coadd or from anywhere, for detection and photometry.

A field needs, in each band, an image, its weight, a realisation of its noise and its PSF. Bands are in memory one at a
time, and for the detection image some rows of all bands.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
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
from romandask.stages.coadds.tile_maker import Coadds
from romandask.storage.arrays import chunk_side

Window = tuple[slice, ...]
"""Rows and columns of a plane."""
WHOLE: Window = (slice(None), slice(None))
_CHUNKS = 3
"""Chunks in a row, of all bands, that are in memory for the detection image."""


@dataclass(frozen=True, kw_only=True)
class Field(ABC):
    """Images of one piece of sky in some bands, all on one pixel grid."""

    bands: tuple[str, ...]
    """Bands in which objects are measured."""
    detection_bands: tuple[str, ...]
    """Bands in which they are detected."""
    method: Literal["median", "peaks"]
    """median: Source Extractor's on the median of bands; peaks: those of their weighted mean, smoothed with its PSF."""
    pixel_scale: float
    """arcsec"""
    aperture: float
    """Radius of aperture photometry, arcsec."""
    electrons_per_njy: Mapping[str, float]
    """By band: electrons per nJy and unit exposure, which is a second, or the unit of `nimages`; 0 without Poisson
    noise of the sources."""
    weight_is_exposure_time: bool
    """True where the exposure of a pixel follows from its weight; False where it is the array `nimages`."""

    @abstractmethod
    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return a window (rows, columns) of arrays of a band.

        Names: `image` (nJy), `weight` (0 for no data), `noise` (a realisation, nJy), `dq`, `nimages`; and `psf`, which
        is whole in any window.
        """

    def measurement(self, band: str) -> MeasurementImage:
        """Return one band for photometry: three planes in memory while it is made, two in the end."""
        noise, weight = self.arrays(band, ("noise", "weight")).values()
        rms = rms_of(noise, weight)
        error, mask = errors(weight, rms)
        ratios = noise_ratios(noise, error, mask)
        psf = self.arrays(band, ("psf",))["psf"]
        spread = psf_fit.scatter(noise, psf, error)
        # noise and weight are not needed any more: make room for the image
        del noise, weight
        release_free_memory()
        exposures = None if self.weight_is_exposure_time else self.arrays(band, ("nimages",))["nimages"]
        image = self.arrays(band, ("image",))["image"]
        return MeasurementImage(image, error, mask, ratios, psf, spread, self.electrons_per_njy[band], rms, exposures)

    def saturated(self, band: str) -> np.ndarray:
        """True (ny, nx) where a band is saturated."""
        return (self.arrays(band, ("dq",))["dq"] & SATURATED) > 0

    def detection(self) -> MeasurementImage:
        """Return the detection image: the median of bands, or their mean with inverse variances."""
        bands = self.detection_bands
        scales, spreads = [], []
        for band in bands:
            noise, weight = self.arrays(band, ("noise", "weight")).values()
            spreads.append(rms_of(noise, weight))
            some = weight[::8, ::8]
            scales.append(float(np.median(some[some > 0])) if (some > 0).any() else 0.0)
            shape = weight.shape
            del noise, weight, some
        image, noise, total = (np.empty(shape, np.float32) for _ in range(3))
        for part in _blocks(shape):
            parts = [self.arrays(band, ("image", "noise", "weight"), part) for band in bands]
            weights = [one["weight"] for one in parts]
            if self.method == "median":
                image[part], noise[part] = (
                    median([one[name] for one in parts], weights) for name in ("image", "noise")
                )
                total[part] = sum(w / s for w, s in zip(weights, scales, strict=True) if s > 0) / len(bands)
            else:
                image[part], total[part] = weighted_mean([one["image"] for one in parts], weights, spreads)
                noise[part], _ = weighted_mean([one["noise"] for one in parts], weights, spreads)
        error, mask = errors(total, rms_of(noise, total))
        psf = np.mean([self.arrays(band, ("psf",))["psf"] for band in bands], axis=0)
        return MeasurementImage(
            image, error, mask, noise_ratios(noise, error, mask), psf, psf_fit.scatter(noise, psf, error)
        )


@dataclass(frozen=True, kw_only=True)
class TileField(Field):
    """One tile of a survey's coadds."""

    coadds: Coadds
    tile: int
    """Its number."""
    readers: dict[int, Callable[[str, Window], np.ndarray]] = field(default_factory=dict)
    """By unit, a reader of windows: from the store, or from memory where the tile is not stored."""

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return a window (rows, columns) of arrays of a band; of noise the first realisation."""
        index = self.coadds.index(self.tile, band)
        if index not in self.readers:
            if self.coadds.has(index):
                self.readers[index] = self.coadds.reader(index)
            else:
                made = self.coadds.load(index)
                self.readers[index] = lambda name, part: made[name][(..., *part)].copy()
        windows = {name: {"psf": (), "noise": (slice(0, 1), *window)}.get(name, window) for name in names}
        found = {name: self.readers[index](name, part) for name, part in windows.items()}
        return {name: plane[0] if name == "noise" else plane for name, plane in found.items()}


@dataclass(frozen=True, kw_only=True)
class ArrayField(Field):
    """Images in memory, made by any program."""

    images: Mapping[str, Mapping[str, np.ndarray]]
    """By band and name, as `arrays` returns them; without `dq` no pixel is saturated."""

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return a window (rows, columns) of arrays of a band."""
        planes = self.images[band]
        none = np.zeros(planes["image"].shape, np.uint8)
        found = {name: planes.get(name, none) if name == "dq" else planes[name] for name in names}
        return {name: plane if name == "psf" else plane[window].copy() for name, plane in found.items()}


def tile_field(coadds: Coadds, tile: int) -> TileField:
    """Return one tile of a survey's coadds, by its number, as its instrument is measured."""
    instrument = coadds.instrument
    drizzled = instrument.coadd == "drizzle"
    rates = {band: instrument.bandpass(band).ab_photons() / NJY_ZERO_POINT for band in instrument.bands}
    if not drizzled:
        rates = {band: rate * instrument.visit_seconds for band, rate in rates.items()}
    return TileField(
        bands=instrument.bands,
        detection_bands=instrument.detection_bands or instrument.bands,
        method=instrument.detection,
        pixel_scale=instrument.coadd_scale,
        aperture=instrument.aperture,
        electrons_per_njy=rates,
        weight_is_exposure_time=drizzled,
        coadds=coadds,
        tile=tile,
    )


def _blocks(shape: tuple[int, int]) -> Iterator[Window]:
    """Yield windows that cover a plane, of whole chunks: none is decoded twice."""
    height, width = chunk_side(shape[0]), _CHUNKS * chunk_side(shape[1])
    for top in range(0, shape[0], height):
        for left in range(0, shape[1], width):
            yield slice(top, top + height), slice(left, left + width)
