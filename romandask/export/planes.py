"""Errors and flags of pixels, for the image formats that hold them."""

from __future__ import annotations

import numpy as np

from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.measurement.measurement_image import errors, rms_of
from romandask.products.images import ImageProduct
from romandask.stages.coadds.tile_maker import Coadds


def counted_variance(image: np.ndarray, detector: Detector) -> np.ndarray:
    """Return the variance of an exposure as a pipeline would estimate it from the image.

    Parameters
    ----------
    image : ndarray, shape (ny, nx), electrons
        Image with its sky.
    detector : Detector
        Detector, for its read noise.

    Returns
    -------
    ndarray, float32, shape (ny, nx), electrons^2
        Number of counted electrons, those of the sky included, plus the square of the read noise.
    """
    return np.maximum(image, 0).astype(np.float32) + np.float32(detector.read_noise**2)


def tile_error(coadds: Coadds, tile: int, band: str) -> np.ndarray:
    """Return the standard deviation (ny, nx) of the empty pixels of a tile, nJy; 0 in pixels without an exposure."""
    image = coadds.tile_image(tile, band)
    noise, weight = image("noise", (slice(0, 1), slice(None), slice(None)))[0], image("weight")
    return errors(weight, rms_of(noise, weight))[0]


def flags_of(product: ImageProduct) -> dict[str, int]:
    """Return the bit mask of each flag of the array `dq`, by the name of the flag."""
    attributes = next(variable for variable in product.variables if variable.name == "dq").attributes
    masks, names = attributes.get("flag_masks", []), str(attributes.get("flag_meanings", "")).split()
    return dict(zip(names, masks, strict=True))
