"""Detected objects: their shapes, numbers and flags, and the part of an image in which they are detected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sep

NOT_DEBLENDED, NO_DATA, SATURATED_CORE = 256, 512, 1024
"""Bits of the flags column beyond those of sep."""
FLAGS = {
    "deblended": sep.OBJ_MERGED,
    "truncated": sep.OBJ_TRUNC,
    "deblend_overflow": sep.OBJ_DOVERFLOW,
    "singular": sep.OBJ_SINGU,
    "aperture_truncated": sep.APER_TRUNC,
    "aperture_masked": sep.APER_HASMASKED,
    "aperture_all_masked": sep.APER_ALLMASKED,
    "kron_nonpositive": sep.APER_NONPOSITIVE,
    "not_deblended": NOT_DEBLENDED,
    "no_data": NO_DATA,
    "saturated": SATURATED_CORE,
}
"""Bits of the flags column, by name: those of sep, then NOT_DEBLENDED, NO_DATA and SATURATED_CORE."""
Window = tuple[slice, slice]
"""Rows and columns of an image."""
WHOLE: Window = (slice(None), slice(None))
"""Window that covers an image."""


@dataclass(frozen=True)
class Part:
    """Place of a detection image in a larger image, whose pixels number the objects.

    An object has the number y * width + x + 1 of the pixel of its peak, which does not depend on other objects: it has
    the same number in every part of the image that contains it.
    """

    width: int
    """Width of the larger image, pixels."""
    x: int
    """Column of the larger image that is the first of the detection image."""
    y: int
    """Row of the larger image that is the first of the detection image."""
    inner: Window
    """Window of the detection image. Only objects with their peak in it are measured."""

    def numbers(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the numbers, (n,) int32, of objects with peaks in some pixels of the detection image."""
        return ((np.asarray(y, np.int64) + self.y) * self.width + np.asarray(x, np.int64) + self.x + 1).astype(np.int32)

    def contains(self, x: np.ndarray, y: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return True, (n,), for pixels of the detection image, of a shape (ny, nx), in the inner window."""
        (top, bottom, _), (left, right, _) = (
            part.indices(length) for part, length in zip(self.inner, shape, strict=True)
        )
        return (y >= top) & (y < bottom) & (x >= left) & (x < right)


@dataclass(frozen=True, kw_only=True)
class DetectedObjects:
    """Objects of a detection image; all arrays are of shape (n,), positions 0 at the centre of the first pixel."""

    label: np.ndarray
    """Number in the segmentation map (see `Part`)."""
    x: np.ndarray
    """x under a Gaussian window (XWIN), pixels."""
    y: np.ndarray
    """y under a Gaussian window (YWIN), pixels."""
    barycentre_x: np.ndarray
    """x of the barycentre of the isophote, the centre of the apertures, pixels."""
    barycentre_y: np.ndarray
    """y of the barycentre of the isophote, pixels."""
    a: np.ndarray
    """Semi-major axis, pixels."""
    b: np.ndarray
    """Semi-minor axis, pixels."""
    theta: np.ndarray
    """Angle of the major axis from the x axis, radians."""
    x2: np.ndarray
    """Second moment in x, pixels^2."""
    y2: np.ndarray
    """Second moment in y, pixels^2."""
    xy: np.ndarray
    """Mixed second moment, pixels^2."""
    kron_radius: np.ndarray
    """Radius of the Kron aperture, semi-axes."""
    half_light_radius: np.ndarray
    """Radius of the circle that holds half of the Kron flux, pixels; 1 where it cannot be measured."""
    snr: np.ndarray
    """Signal to noise: of the Kron flux (`detect`), or of a point source at the peak (`detect_peaks`)."""
    blendedness: np.ndarray
    """Share of the light at the object that belongs to its neighbours; NaN where there is no light."""
    flags: np.ndarray
    """Bits of FLAGS."""


def select(objects: DetectedObjects, keep: np.ndarray) -> DetectedObjects:
    """Return the objects for which `keep`, (n,) bool, is True."""
    return DetectedObjects(**{name: value[keep] for name, value in vars(objects).items()})
