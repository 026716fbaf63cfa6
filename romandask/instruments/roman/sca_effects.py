"""What each effect of an SCA does to an exposure: the image with it less the image without it, all else the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pandas as pd

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Light
from romandask.instruments.roman.sca_readout import ScaReadout, age_and_traps
from romandask.kernels.detectors.sca import count_rate_nonlinearity, expand, quantum_efficiency
from romandask.kernels.detectors.sca_exposure import Planes, Response, accumulate, afterglow, read_out
from romandask.kernels.detectors.synthetic_sca import REFERENCE, REFERENCE_PIXELS, SCA_PIXELS

_ALONE = np.pad(np.ones((1, 1), np.float32), 1)[:, :, None, None]
"""The kernel (3, 3) of a pixel that keeps what it has."""
NEUTRAL: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "brighter-fatter": ("BFE", np.zeros_like),
    "dark current": ("DARK", np.zeros_like),
    "saturation": ("SATURATE", lambda plane: np.full_like(plane, np.iinfo(np.int32).max)),
    "classical nonlinearity": ("CNL", np.zeros_like),
    "interpixel capacitance": ("IPC", lambda plane: np.zeros_like(plane) + _ALONE),
    "bad pixels": ("BADPIX", lambda plane: plane & np.array(REFERENCE, plane.dtype)),
    "read noise": ("READ", np.zeros_like),
}
"""By effect, the calibration that makes it, and that calibration without it."""


def effect_images(
    readout: ScaReadout,
    light: Light,
    truth: np.ndarray,
    left: Sequence[tuple[Exposure, pd.DataFrame]],
    side: int = 96,
) -> dict[str, np.ndarray]:
    """Return what each effect does around the brightest pixel of an exposure, in the order in which they act.

    The random numbers are those of the exposure itself. For quantum efficiency and count-rate nonlinearity, which
    change the light before it is counted, it is the difference of the expected electrons.

    Parameters
    ----------
    readout : ScaReadout
    light : Light
        Of the exposure.
    truth : ndarray, shape (4088, 4088), electrons
        Noiseless image of its objects.
    left : sequence of (Exposure, DataFrame)
        Earlier exposures and what they left in traps.
    side : int
        Pixels along a side of the images.

    Returns
    -------
    dict of str to ndarray, shape (side, side), electrons
        The image as it is read with the effect, less the same without it.
    """
    exposure, electrons = light.exposure, truth + light.background
    square = _square(truth, side)
    planes = readout.planes(exposure)
    response = readout.response(exposure, planes)
    late = afterglow(age_and_traps(exposure, left))
    of = partial(readout.random, exposure)
    charge, rays = readout.charge(exposure, electrons, planes, response)
    whole = _electrons(read_out(charge, planes, response, of, late, rays)[0], planes, square)

    def without(changed: Planes, kept: np.ndarray | None = None, glow: np.ndarray | None = late) -> np.ndarray:
        kept = charge if kept is None else kept
        return whole - _electrons(read_out(kept, changed, response, of, glow, rays)[0], planes, square)

    found = _of_light(electrons, planes, response, square)
    for effect, (name, neutral) in NEUTRAL.items():
        changed = _changed(planes, name, neutral)
        kept = accumulate(electrons, changed, response, of, rays) if name == "BFE" else None
        found[effect] = without(changed, kept)
        if name == "BFE" and late is not None:
            found["persistence"] = without(planes, None, None)
    if rays is not None:
        found["cosmic rays"] = without(planes, accumulate(electrons, planes, response, of, None))
    return found


def _of_light(
    light: np.ndarray, planes: Planes, response: Response, square: tuple[slice, slice]
) -> dict[str, np.ndarray]:
    """Return the effects on what is expected."""
    rows = slice(square[0].start + REFERENCE_PIXELS, square[0].stop + REFERENCE_PIXELS)
    columns = slice(square[1].start + REFERENCE_PIXELS, square[1].stop + REFERENCE_PIXELS)
    here = light[square]
    white, exponent = planes("RELQE1", rows)[:, columns], planes("CRNL", rows)[0][:, columns].astype(np.float32)
    seen = quantum_efficiency(here, white, expand(response.efficiency, 64, rows, columns))
    return {
        "quantum efficiency": seen - here,
        "count-rate nonlinearity": count_rate_nonlinearity(seen, exponent, response.exptime) - seen,
    }


def _changed(planes: Planes, changed: str, neutral: Callable[[np.ndarray], np.ndarray]) -> Planes:
    return lambda name, rows: neutral(planes(name, rows)) if name == changed else planes(name, rows)


def _electrons(numbers: np.ndarray, planes: Planes, square: tuple[slice, slice]) -> np.ndarray:
    """Return a square of data numbers in electrons."""
    rows, columns = (slice(part.start + REFERENCE_PIXELS, part.stop + REFERENCE_PIXELS) for part in square)
    return numbers[square].astype(np.float32) * expand(planes("GAIN", slice(None)), 128, rows, columns)


def _square(truth: np.ndarray, side: int) -> tuple[slice, slice]:
    """Return the square around the brightest pixel."""
    corner = [
        int(np.clip(place - side // 2, 0, SCA_PIXELS - 2 * REFERENCE_PIXELS - side))
        for place in np.unravel_index(truth.argmax(), truth.shape)
    ]
    return slice(corner[0], corner[0] + side), slice(corner[1], corner[1] + side)
