"""A tile's bands for photometry, one at a time, and its detection image, some rows of all bands at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from romandask.instruments.instrument import Instrument
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
from romandask.products.images import ImageProduct
from romandask.products.memory import release_free_memory
from romandask.stages.coadds.tile_maker import unit_of
from romandask.storage.arrays import chunk_side

Window = tuple[slice, ...]
"""Rows and columns of a plane."""
WHOLE: Window = (slice(None), slice(None))
VISIT = 30.0
"""Seconds of a visit, where a coadd's weight is not its exposure time."""
_CHUNKS = 3
"""Chunks in a row, of all bands, that are in memory for the detection image."""


@dataclass(frozen=True)
class TileBands:
    """The bands of one tile of a survey's coadds."""

    coadds: ImageProduct
    instrument: Instrument
    tile: int
    readers: dict[int, Callable[[str, tuple[slice, ...]], np.ndarray]] = field(default_factory=dict)
    """What reads a band: from the store, or, while the tile is worked on, from memory where it is not stored."""

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return a window (rows, columns) of arrays of a band; of noise the first realisation."""
        index = unit_of(self.tile, band, self.instrument.bands)
        if index not in self.readers:
            if self.coadds.has(index):
                self.readers[index] = self.coadds.reader(index)
            else:
                made = self.coadds.load(index)
                self.readers[index] = lambda name, part: made[name][(..., *part)].copy()
        windows = {name: {"psf": (), "noise": (slice(0, 1), *window)}.get(name, window) for name in names}
        found = {name: self.readers[index](name, part) for name, part in windows.items()}
        return {name: plane[0] if name == "noise" else plane for name, plane in found.items()}

    def layer(self, band: str) -> MeasurementImage:
        """Return one band for photometry: three planes in memory while it is made, two in the end."""
        noise, weight = self.arrays(band, ("noise", "weight")).values()
        rms = rms_of(noise, weight)
        error, mask = errors(weight, rms)
        ratios = noise_ratios(noise, error, mask)
        psf = self.arrays(band, ("psf",))["psf"]
        spread = psf_fit.scatter(noise, psf, error)
        # before the image is read: the noise has told what it can
        del noise, weight
        release_free_memory()
        rate = self.instrument.bandpass(band).ab_photons() / NJY_ZERO_POINT
        exposures = None
        if self.instrument.coadd != "drizzle":
            exposures, rate = self.arrays(band, ("nimages",))["nimages"], rate * VISIT
        image = self.arrays(band, ("image",))["image"]
        return MeasurementImage(image, error, mask, ratios, psf, spread, rate, rms, exposures)

    def detection(self) -> MeasurementImage:
        """Return the detection image: the median of bands, or their mean with inverse variances."""
        bands = self.instrument.detection_bands or self.instrument.bands
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
            if self.instrument.detection == "median":
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


def _blocks(shape: tuple[int, int]) -> Iterator[Window]:
    """Yield windows that cover a plane, of whole chunks: none is decoded twice."""
    height, width = chunk_side(shape[0]), _CHUNKS * chunk_side(shape[1])
    for top in range(0, shape[0], height):
        for left in range(0, shape[1], width):
            yield slice(top, top + height), slice(left, left + width)
