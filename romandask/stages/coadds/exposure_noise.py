"""Noise realisations of exposures, which are resampled onto tiles together with the images."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.kernels.detectors.simple_detector import noise_realisation
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

    All tiles that the exposure touches see the same noise.

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
    generator = partial(rng, seed, "coadds", "noise", instrument.name, exposure.visit, exposure.detector)
    for number in range(count):
        yield noise_realisation(variance, instrument.shape[1], *part, partial(generator, *realisation_key(number)))
