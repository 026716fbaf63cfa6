"""Noise realisations of exposures, which are resampled onto tiles together with the images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.kernels.detectors.pixel_noise import pixel_noise
from romandask.model.seeds import realisation_key, rng


def noise_realisations(
    count: int,
    variance: np.ndarray,
    instrument: Instrument,
    exposure: Exposure,
    part: tuple[slice, slice],
    seed: int,
) -> Iterator[np.ndarray]:
    """Yield Gaussian noise realisations of a part of an exposure.

    All patches that the exposure touches see the same noise: a pixel has the same noise in every part.

    Parameters
    ----------
    count : int
        Number of realisations.
    variance : ndarray, shape (rows, columns), electrons^2
        Variance of the pixels of the part.
    instrument : Instrument
        Instrument of the exposure.
    exposure : Exposure
        The exposure.
    part : (slice, slice)
        Rows and columns of the part.
    seed : int
        Seed of the survey.

    Yields
    ------
    ndarray, shape (rows, columns), float32, electrons
    """
    for number in range(count):
        identity = (exposure.visit, exposure.detector, *realisation_key(number))
        key = rng(seed, "coadds", "noise", instrument.name, *identity).integers(1 << 63, dtype=np.uint64)
        yield pixel_noise(variance, instrument.shape[1], part[0].start, part[1].start, key)
