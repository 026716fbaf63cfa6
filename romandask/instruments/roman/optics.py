"""PSFs of Roman's optics: the PSF of an SCA and band as it varies over the SCA, and the PSFs of bright stars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from threading import RLock
from typing import Any

import galsim
import galsim.roman
import numpy as np
from galsim.roman import roman_psfs

from romandask.instruments.roman.bands import BANDS
from romandask.kernels.rendering.diffraction import Pupil, diffraction
from romandask.kernels.rendering.psf import (
    CORE,
    Grid,
    NodeTransforms,
    PsfModel,
    Variation,
    edge_brightness,
    model,
    place_grid,
)
from romandask.kernels.universe.bandpasses import roman_bandpass

PSF_EXTENT_PIXELS = 4096
"""Side of the PSF of the unbinned pupil, pixels; with a pupil binned by n, the side is n times smaller."""
ACTIVE_PIXELS = galsim.roman.n_pix
"""Side of the active area of an SCA, pixels."""
MIDDLE = (ACTIVE_PIXELS / 2 - 0.5, ACTIVE_PIXELS / 2 - 0.5)
"""x and y of the middle of an SCA, pixels, 0 at the centre of the first pixel."""
_LOCK = RLock()
"""Held by the thread that computes pupils or PSFs."""

# by default GalSim keeps the pupils of ten SCAs, half a gigabyte; a worker draws one SCA at a time
roman_psfs._make_aperture.resize(1)


def _one_thread(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that only one thread runs at a time.

    The results are large, and the cache of GalSim holds one pupil for all threads.
    """

    @wraps(function)
    def locked(*arguments: Any) -> Any:
        with _LOCK:
            return function(*arguments)

    return locked


@_one_thread
def optics(sca: int, band: str, wave: float, pupil_bin: int, position: tuple[float, float]) -> galsim.GSObject:
    """Return GalSim's PSF of an SCA at a position and wavelength.

    Parameters
    ----------
    sca : int
        Number of the SCA.
    band : str
        Name of the band.
    wave : float, nm
        Wavelength.
    pupil_bin : int
        Number of cells of the pupil that are binned in each axis.
    position : (float, float), pixels
        x and y on the SCA, 0 at the centre of the first pixel.
    """
    galsim_position = galsim.PositionD(position[0] + 0.5, position[1] + 0.5)
    return galsim.roman.getPSF(sca, band, SCA_pos=galsim_position, pupil_bin=pupil_bin, wavelength=wave)


def transforms(
    sca: int, band: str, waves: np.ndarray, pupil_bin: int, position: tuple[float, float], grid: Grid, diffusion: float
) -> np.ndarray:
    """Return the transforms of the PSFs of `optics`, including the response of a pixel.

    Parameters
    ----------
    sca : int
        Number of the SCA.
    band : str
        Name of the band.
    waves : ndarray, shape (waves,), nm
        Wavelengths.
    pupil_bin : int
        Number of cells of the pupil that are binned in each axis.
    position : (float, float), pixels
        x and y on the SCA, 0 at the centre of the first pixel.
    grid : Grid
        Frequencies.
    diffusion : float, pixels
        Sigma of the diffusion of charge.

    Returns
    -------
    ndarray, shape (waves, *grid.shape), complex64
    """
    binned_pupil = pupil(sca, band, pupil_bin)
    out = np.empty((len(waves), *grid.shape), np.complex64)
    for node, wave in enumerate(waves):
        out[node] = diffraction(binned_pupil, wave, grid, galsim.roman.pixel_scale, diffusion).transform(
            aberrations(sca, wave, position)
        )
    return out


def aberrations(sca: int, wave: float, position: tuple[float, float]) -> np.ndarray:
    """Return the coefficients of GalSim's Zernike polynomials at a position and wavelength.

    Parameters
    ----------
    sca : int
        Number of the SCA.
    wave : float, nm
        Wavelength.
    position : (float, float), pixels
        x and y on the SCA, 0 at the centre of the first pixel.

    Returns
    -------
    ndarray, shape (23,), waves
    """
    galsim_position = galsim.PositionD(position[0] + 0.5, position[1] + 0.5)
    coefficients = roman_psfs._interp_aberrations_bilinear(*_aberrations(sca), galsim_position)
    # as in GalSim, the first four are zero: piston has no effect, and tip and tilt shift the image
    coefficients[:4] = 0.0
    return coefficients * roman_psfs.zemax_wavelength / wave


def pupil(sca: int, band: str, pupil_bin: int) -> Pupil:
    """Return the pupil of an SCA in a band, with `pupil_bin` cells binned in each axis."""
    return _pupil(sca, "long" if band in roman_psfs.longwave_bands else "short", pupil_bin)


@lru_cache(maxsize=1)
@_one_thread
def _pupil(sca: int, pupil_plane_type: str, pupil_bin: int) -> Pupil:
    # the cells do not depend on the wavelength
    aperture = roman_psfs._make_aperture(sca, pupil_plane_type, pupil_bin, roman_psfs.zemax_wavelength, None)
    return Pupil(
        aperture.npix,
        aperture.pupil_plane_scale,
        galsim.roman.diameter / 2,
        aperture.u_illuminated,
        aperture.v_illuminated,
    )


@lru_cache(maxsize=18)
def _aberrations(sca: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tabulated aberrations of an SCA, and x and y of their positions, as GalSim reads them."""
    return roman_psfs._read_aberrations(sca)


@lru_cache(maxsize=128)
def edges(sca: int, band: str, n_waves: int, diffusion: float) -> dict[int, float]:
    """Return the surface brightness of a unit star at the edges of stamps, by stamp size; see `edge_brightness`.

    The PSFs are those at the first and at the last node of the band, in the middle of the SCA.
    """
    waves, grid = roman_bandpass(band, n_waves).nodes, Grid(PSF_EXTENT_PIXELS // 8, BANDS[band].frequency_folds)
    return edge_brightness(transforms(sca, band, waves[[0, -1]], 8, MIDDLE, grid, diffusion), grid)


@_one_thread
def over_sca(sca: int, band: str, n_waves: int, degree: int, diffusion: float) -> PsfModel:
    """Return the PSF of an SCA and band, which varies over the SCA.

    Parameters
    ----------
    sca : int
        Number of the SCA.
    band : str
        Name of the band.
    n_waves : int
        Number of nodes of the band.
    degree : int
        Degree of the polynomials in x and y by which the PSF varies; 0 for a PSF that does not vary.
    diffusion : float, pixels
        Sigma of the diffusion of charge.
    """
    waves, binned_pupil = roman_bandpass(band, n_waves).nodes, pupil(sca, band, 8)
    grid, core = Grid(PSF_EXTENT_PIXELS // 8, BANDS[band].frequency_folds), Grid(CORE, BANDS[band].frequency_folds)
    positions = place_grid((ACTIVE_PIXELS, ACTIVE_PIXELS), degree) if degree else np.empty((0, 2))
    nodes = transforms(sca, band, waves, 8, MIDDLE, grid, diffusion)
    differences = np.empty((n_waves, len(positions), *core.shape), np.complex64)
    middle = grid.within(nodes, core.size)
    for node, wave in enumerate(waves):
        core_diffraction = diffraction(binned_pupil, wave, core, galsim.roman.pixel_scale, diffusion)
        for number, (x, y) in enumerate(positions):
            differences[node, number] = core_diffraction.transform(aberrations(sca, wave, (x, y))) - middle[node]
    return model(nodes, grid, Variation((ACTIVE_PIXELS, ACTIVE_PIXELS), degree, differences) if degree else None)


@dataclass(frozen=True, kw_only=True)
class WideNodes(NodeTransforms):
    """PSFs of a finer pupil in the middle of an SCA, for `BrightPsf.nodes`."""

    sca: int
    """Number of the SCA."""
    band: str
    """Name of the band."""
    waves: tuple[float, ...]
    """Wavelengths, nm."""
    pupil_bin: int
    """Number of cells of the pupil that are binned in each axis."""
    grid: Grid
    """Frequencies of the transforms."""
    diffusion: float
    """Sigma of the diffusion of charge, pixels."""

    def __len__(self) -> int:
        return len(self.waves)

    @_one_thread
    def transform(self, node: int) -> np.ndarray:
        """Return the transform (grid.shape) of the PSF at a node."""
        waves = np.array([self.waves[node]])
        return transforms(self.sca, self.band, waves, self.pupil_bin, MIDDLE, self.grid, self.diffusion)[0]
