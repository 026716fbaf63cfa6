"""Images of each detector effect of an SCA: the difference between exposures with and without the effect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pandas as pd

from romandask.instruments.exposure import Exposure
from romandask.instruments.readout import Light
from romandask.instruments.roman.sca_readout import ScaReadout, age_and_traps
from romandask.kernels.detectors.sca import count_rate_nonlinearity, expand, quantum_efficiency
from romandask.kernels.detectors.sca_exposure import Planes, Response, accumulate, afterglow, read_out
from romandask.kernels.detectors.synthetic_sca import REFERENCE, REFERENCE_PIXELS, SCA_PIXELS

_NO_COUPLING = np.pad(np.ones((1, 1), np.float32), 1)[:, :, None, None]
"""Interpixel capacitance of pixels without coupling, a kernel of shape (3, 3, 1, 1)."""
NEUTRAL: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "brighter-fatter": ("BFE", np.zeros_like),
    "dark current": ("DARK", np.zeros_like),
    "saturation": ("SATURATE", lambda plane: np.full_like(plane, np.iinfo(np.int32).max)),
    "classical nonlinearity": ("CNL", np.zeros_like),
    "interpixel capacitance": ("IPC", lambda plane: np.zeros_like(plane) + _NO_COUPLING),
    "bad pixels": ("BADPIX", lambda plane: plane & np.array(REFERENCE, plane.dtype)),
    "read noise": ("READ", np.zeros_like),
}
"""For each effect, the calibration that causes it, and a function that returns the calibration without the effect."""


def effect_images(
    readout: ScaReadout,
    light: Light,
    truth: np.ndarray,
    left: Sequence[tuple[Exposure, pd.DataFrame]],
    side: int = 96,
) -> dict[str, np.ndarray]:
    """Return images of the change that each effect makes around the brightest pixel of an exposure.

    The random numbers are those of the exposure itself. Quantum efficiency and count-rate nonlinearity change the light
    before it is counted; their images are differences of expected electrons.

    Parameters
    ----------
    readout : ScaReadout
        Readout of the exposure.
    light : Light
        The light of the exposure.
    truth : ndarray, shape (4088, 4088), electrons
        Noiseless image of the objects.
    left : sequence of (Exposure, DataFrame)
        Earlier exposures, each with its table of trapped charge.
    side : int
        Side of the images, pixels.

    Returns
    -------
    dict of str to ndarray, shape (side, side), electrons
        The raw image with the effect minus the raw image without it, by name of the effect, in the order in which the
        effects act.
    """
    exposure, electrons = light.exposure, truth + light.background
    square = _square(truth, side)
    planes = readout.planes(exposure)
    response = readout.response(exposure, planes)
    persistence = afterglow(age_and_traps(exposure, left))
    generators = partial(readout.random, exposure)
    charge, rays = readout.charge(exposure, electrons, planes, response)
    complete = _electrons(read_out(charge, planes, response, generators, persistence, rays)[0], planes, square)

    def change(planes_without: Planes, charge: np.ndarray, persistence: np.ndarray | None) -> np.ndarray:
        """Return the complete image minus the image that is read out with other arguments."""
        numbers, _ = read_out(charge, planes_without, response, generators, persistence, rays)
        return complete - _electrons(numbers, planes, square)

    images = _light_effects(electrons, planes, response, square)
    for effect, (name, neutral) in NEUTRAL.items():
        planes_without = _replaced(planes, name, neutral)
        if name == "BFE":
            charge_without = accumulate(electrons, planes_without, response, generators, rays)
            images[effect] = change(planes_without, charge_without, persistence)
            if persistence is not None:
                images["persistence"] = change(planes, charge, None)
        else:
            images[effect] = change(planes_without, charge, persistence)
    if rays is not None:
        charge_without = accumulate(electrons, planes, response, generators, None)
        images["cosmic rays"] = change(planes, charge_without, persistence)
    return images


def _light_effects(
    light: np.ndarray, planes: Planes, response: Response, square: tuple[slice, slice]
) -> dict[str, np.ndarray]:
    """Return the effects on the expected electrons: quantum efficiency and count-rate nonlinearity."""
    rows = slice(square[0].start + REFERENCE_PIXELS, square[0].stop + REFERENCE_PIXELS)
    columns = slice(square[1].start + REFERENCE_PIXELS, square[1].stop + REFERENCE_PIXELS)
    part = light[square]
    white, exponent = planes("RELQE1", rows)[:, columns], planes("CRNL", rows)[0][:, columns].astype(np.float32)
    detected = quantum_efficiency(part, white, expand(response.efficiency, 64, rows, columns))
    return {
        "quantum efficiency": detected - part,
        "count-rate nonlinearity": count_rate_nonlinearity(detected, exponent, response.exptime) - detected,
    }


def _replaced(planes: Planes, replaced: str, neutral: Callable[[np.ndarray], np.ndarray]) -> Planes:
    """Return the calibrations with one of them replaced by `neutral` of it."""
    return lambda name, rows: neutral(planes(name, rows)) if name == replaced else planes(name, rows)


def _electrons(numbers: np.ndarray, planes: Planes, square: tuple[slice, slice]) -> np.ndarray:
    """Return a square part of an image of data numbers, converted to electrons with the gain."""
    rows, columns = (slice(part.start + REFERENCE_PIXELS, part.stop + REFERENCE_PIXELS) for part in square)
    return numbers[square].astype(np.float32) * expand(planes("GAIN", slice(None)), 128, rows, columns)


def _square(truth: np.ndarray, side: int) -> tuple[slice, slice]:
    """Return the rows and columns of the square around the brightest pixel."""
    corner = [
        int(np.clip(index - side // 2, 0, SCA_PIXELS - 2 * REFERENCE_PIXELS - side))
        for index in np.unravel_index(truth.argmax(), truth.shape)
    ]
    return slice(corner[0], corner[0] + side), slice(corner[1], corner[1] + side)
