"""Fields: images of one area of the sky in one or more bands, from which objects are detected and measured.

A field has, in each band, an image, its weight, a realisation of its noise and its PSF. It may be a part of a larger
image, whose noise is then measured once for all its parts. Photometry holds one band in memory at a time; the detection
image is made from small windows of all bands.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.kernels.measurement.detected_objects import WHOLE
from romandask.kernels.measurement.measurement_image import MeasurementImage, errors, median, weighted_mean
from romandask.kernels.measurement.noise import Noise, measured_noise
from romandask.products.memory import release_free_memory
from romandask.storage.arrays import chunk_side

Window = tuple[slice, ...]
"""Rows and columns of an image."""
_CHUNKS = 3
"""Width, in chunks, of the windows of all bands that are in memory while the detection image is made."""


@dataclass(frozen=True, kw_only=True)
class FieldNoise:
    """Noise of the bands and of the detection image of a field."""

    bands: Mapping[str, Noise]
    """Noise of each band."""
    weights: Mapping[str, float]
    """Median weight of each band, by which the weights of the bands are comparable."""
    detection: Noise
    """Noise of the detection image."""
    psf: np.ndarray
    """PSF of the detection image, of unit flux, (side, side)."""


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

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the images."""

    def strips(self) -> Iterator[Window]:
        """Yield windows that cover the images and consist of whole chunks, so that no chunk is decoded twice."""
        height, width = chunk_side(self.shape[0]), _CHUNKS * chunk_side(self.shape[1])
        for top in range(0, self.shape[0], height):
            for left in range(0, self.shape[1], width):
                yield slice(top, top + height), slice(left, left + width)

    def measurement(self, band: str, noise: Noise) -> MeasurementImage:
        """Return the measurement image of a band, whose noise is given."""
        error, mask = errors(self.arrays(band, ("weight",))["weight"], noise.rms)
        release_free_memory()
        exposures = None if self.weight_is_exposure_time else self.arrays(band, ("nimages",))["nimages"]
        arrays = self.arrays(band, ("image", "psf"))
        return MeasurementImage(
            image=arrays["image"],
            error=error,
            mask=mask,
            aperture_ratios=noise.aperture_ratios,
            psf=arrays["psf"],
            psf_ratio=noise.psf_ratio,
            electrons_per_flux=self.electrons_per_njy[band],
            rms=noise.rms,
            exposure_map=exposures,
        )

    def saturated(self, band: str) -> np.ndarray:
        """Return True, (ny, nx), for the saturated pixels of a band."""
        return (self.arrays(band, ("dq",))["dq"] & SATURATED) > 0

    def detection(self, noise: FieldNoise) -> MeasurementImage:
        """Return the detection image: the median of the detection bands, or their inverse-variance weighted mean."""
        image, total = self._all_combined("image", noise.bands, noise.weights)
        error, mask = errors(total, noise.detection.rms)
        return MeasurementImage(
            image=image,
            error=error,
            mask=mask,
            aperture_ratios=noise.detection.aperture_ratios,
            psf=noise.psf,
            psf_ratio=noise.detection.psf_ratio,
        )

    def combined(
        self, name: str, window: Window, noise: Mapping[str, Noise], weights: Mapping[str, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a window of an array, combined over the detection bands as in the detection image, and its weight.

        Parameters
        ----------
        name : str
            `image` or `noise`.
        window : tuple of slice
        noise, weights
            As in `FieldNoise`.

        Returns
        -------
        values, weight : ndarray, shape (ny, nx), float32
        """
        bands = self.detection_bands
        planes = [self.arrays(band, (name, "weight"), window) for band in bands]
        values, own = [arrays[name] for arrays in planes], [arrays["weight"] for arrays in planes]
        if self.method == "peaks":
            return weighted_mean(values, own, [noise[band].rms for band in bands])
        # each weight in units of the median weight of its band
        typical = [weights[band] for band in bands]
        total = sum((w / m for w, m in zip(own, typical, strict=True) if m > 0), np.zeros_like(own[0])) / len(bands)
        return median(values, own), total

    def _all_combined(
        self, name: str, noise: Mapping[str, Noise], weights: Mapping[str, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `combined` of the whole field, made in strips."""
        values, total = (np.empty(self.shape, np.float32) for _ in range(2))
        for window in self.strips():
            values[window], total[window] = self.combined(name, window, noise, weights)
        return values, total

    def noise(self, windows: Sequence[Window] = ()) -> FieldNoise:
        """Measure the noise of the bands and of the detection image.

        Parameters
        ----------
        windows : sequence of tuple of slice
            Windows, of one size, in which the noise is measured; by default the whole field.
        """
        bands, weights = {}, {}
        for band in dict.fromkeys((*self.bands, *self.detection_bands)):
            planes = [self.arrays(band, ("noise", "weight"), window) for window in windows or (WHOLE,)]
            noise, weight = (_stacked([arrays[name] for arrays in planes]) for name in ("noise", "weight"))
            del planes
            sampled = weight[:, ::8, ::8]
            weights[band] = float(np.median(sampled[sampled > 0])) if (sampled > 0).any() else 0.0
            bands[band] = measured_noise(noise, weight, self.arrays(band, ("psf",))["psf"])
            del noise, weight, sampled
            release_free_memory()
        psf = np.mean([self.arrays(band, ("psf",))["psf"] for band in self.detection_bands], axis=0)
        parts = [self.combined("noise", window, bands, weights) for window in windows]
        parts = parts or [self._all_combined("noise", bands, weights)]
        noise, weight = (_stacked([part[k] for part in parts]) for k in (0, 1))
        return FieldNoise(bands=bands, weights=weights, detection=measured_noise(noise, weight, psf), psf=psf)


@dataclass(frozen=True, kw_only=True)
class ArrayField(Field):
    """Images in memory, from any program."""

    images: Mapping[str, Mapping[str, np.ndarray]]
    """Arrays by band and name (see `Field.arrays`). Without `dq`, no pixel is saturated."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        ny, nx = self.images[self.bands[0]]["image"].shape
        return ny, nx

    def arrays(self, band: str, names: tuple[str, ...], window: Window = WHOLE) -> dict[str, np.ndarray]:
        """Return arrays of a band, by name (see `Field.arrays`)."""
        images = self.images[band]
        no_flags = np.zeros(images["image"].shape, np.uint8)
        arrays = {name: images.get(name, no_flags) if name == "dq" else images[name] for name in names}
        # copies, because weights are overwritten in place
        return {name: array if name == "psf" else array[window].copy() for name, array in arrays.items()}


def _stacked(planes: list[np.ndarray]) -> np.ndarray:
    """Return planes (ny, nx) of one shape as one array (n, ny, nx); a single plane is not copied."""
    return planes[0][None] if len(planes) == 1 else np.stack(planes)
