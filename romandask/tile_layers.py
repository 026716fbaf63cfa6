"""A tile's bands for photometry, one at a time, and its detection image, some rows of all bands at a time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from romandask.instruments.exposure import Instrument
from romandask.kernels.extract import with_psf_ratio
from romandask.kernels.layer import Layer, errors, median, noise_ratios, rms_of, weighted_mean
from romandask.model.spectra import NJY_ZERO_POINT
from romandask.runtime.products import ImageProduct

VISIT = 30.0
"""Seconds of a visit, where a coadd's weight is not its exposure time."""
_ROWS = 1024
"""Rows of all bands that are in memory for the detection image."""


@dataclass(frozen=True)
class TileBands:
    """The bands of one tile of a survey's coadds."""

    coadds: ImageProduct
    instrument: Instrument
    tile: int
    made: dict[int, dict[str, np.ndarray]] = field(default_factory=dict)
    """Bands that are not stored, kept while the tile is worked on."""

    def arrays(self, band: str, names: tuple[str, ...], rows: slice = slice(None)) -> dict[str, np.ndarray]:
        """Return some rows of arrays of a band; of noise the first realisation."""
        index = self.tile * len(self.instrument.bands) + self.instrument.bands.index(band)
        if index not in self.made and not self.coadds.has(index):
            self.made[index] = self.coadds.load(index)
        part = (rows, slice(None))
        windows = {name: {"psf": (), "noise": (slice(0, 1), *part)}.get(name, part) for name in names}
        if index in self.made:
            found = {name: self.made[index][name][window].copy() for name, window in windows.items()}
        else:
            found = {name: self.coadds.load(index, (name,), window)[name] for name, window in windows.items()}
        return {name: plane[0] if name == "noise" else plane for name, plane in found.items()}

    def layer(self, band: str) -> Layer:
        """Return one band for photometry: three planes in memory while it is made, two in the end."""
        noise, weight = self.arrays(band, ("noise", "weight")).values()
        rms = rms_of(noise, weight)
        error, mask = errors(weight, rms)
        ratios = noise_ratios(noise, error, mask)
        image, psf = self.arrays(band, ("image", "psf")).values()
        rate = self.instrument.bandpass(band).ab_photons() / NJY_ZERO_POINT
        exposures = None
        if self.instrument.coadd_from != "exposures":
            exposures, rate = self.arrays(band, ("nimages",))["nimages"], rate * VISIT
        layer = Layer(image, error, mask, ratios, psf, 1.0, rate, rms, exposures)
        return with_psf_ratio(layer, noise)

    def detection(self) -> Layer:
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
        for first in range(0, shape[0], _ROWS):
            rows = slice(first, min(first + _ROWS, shape[0]))
            parts = [self.arrays(band, ("image", "noise", "weight"), rows) for band in bands]
            weights = [part["weight"] for part in parts]
            if self.instrument.detection == "median":
                image[rows], noise[rows] = (
                    median([part[name] for part in parts], weights) for name in ("image", "noise")
                )
                total[rows] = sum(w / s for w, s in zip(weights, scales, strict=True) if s > 0) / len(bands)
            else:
                image[rows], total[rows] = weighted_mean([part["image"] for part in parts], weights, spreads)
                noise[rows], _ = weighted_mean([part["noise"] for part in parts], weights, spreads)
        error, mask = errors(total, rms_of(noise, total))
        psf = np.mean([self.arrays(band, ("psf",))["psf"] for band in bands], axis=0)
        return Layer(image, error, mask, noise_ratios(noise, error, mask), psf)
