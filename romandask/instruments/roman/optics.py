"""The PSFs of Roman's optics: of an SCA and band, as they vary over it, and of the brightest stars."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, wraps
from tempfile import TemporaryFile
from threading import RLock
from typing import Any

import galsim
import galsim.roman
import numpy as np
from galsim.roman import roman_psfs

from romandask.instruments.roman.bands import BANDS
from romandask.kernels.rendering.diffraction import Pupil, diffraction
from romandask.kernels.rendering.psf import CORE, Grid, PsfModel, Variation, edge_brightness, model, place_grid
from romandask.kernels.universe.bandpasses import roman_bandpass

PSF_EXTENT_PIXELS = 4096
"""Pixels, a side, that a PSF of the unbinned pupil covers; one of a binned pupil covers so many times less."""
ACTIVE_PIXELS = galsim.roman.n_pix
MIDDLE = (ACTIVE_PIXELS / 2 - 0.5, ACTIVE_PIXELS / 2 - 0.5)
"""Of an SCA, pixels, 0 at the first pixel's centre."""
_ALONE = RLock()

# GalSim keeps the pupils of ten SCAs, half a gigabyte; a worker draws one SCA at a time
roman_psfs._make_aperture.resize(1)


def _one_thread(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that one thread at a time runs: what it makes is large, and GalSim keeps one pupil for all."""

    @wraps(function)
    def alone(*arguments: Any) -> Any:
        with _ALONE:
            return function(*arguments)

    return alone


@_one_thread
def optics(sca: int, band: str, wave: float, pupil_bin: int, place: tuple[float, float]) -> galsim.GSObject:
    """Return GalSim's PSF of an SCA at a place (pixels, 0 at the first pixel's centre) and wavelength (nm)."""
    where = galsim.PositionD(place[0] + 0.5, place[1] + 0.5)
    return galsim.roman.getPSF(sca, band, SCA_pos=where, pupil_bin=pupil_bin, wavelength=wave)


def transforms(
    sca: int, band: str, waves: np.ndarray, pupil_bin: int, place: tuple[float, float], grid: Grid, diffusion: float
) -> np.ndarray:
    """Return the transforms (waves, *grid.shape) of the PSFs of `optics` with the response of a pixel.

    Parameters
    ----------
    waves : nm
    place : pixels, 0 at the first pixel's centre
    diffusion : sigma, pixels, by which charge diffuses
    """
    lens = pupil(sca, band, pupil_bin)
    out = np.empty((len(waves), *grid.shape), np.complex64)
    for node, wave in enumerate(waves):
        out[node] = diffraction(lens, wave, grid, galsim.roman.pixel_scale, diffusion).transform(
            aberrations(sca, wave, place)
        )
    return out


def aberrations(sca: int, wave: float, place: tuple[float, float]) -> np.ndarray:
    """Return the coefficients (23,), waves, of GalSim's Zernike polynomials at a place and wavelength (nm)."""
    where = galsim.PositionD(place[0] + 0.5, place[1] + 0.5)
    found = roman_psfs._interp_aberrations_bilinear(*_aberrations(sca), where)
    # piston is not seen, and tip and tilt shift the image: GalSim takes the first four for none
    found[:4] = 0.0
    return found * roman_psfs.zemax_wavelength / wave


def pupil(sca: int, band: str, pupil_bin: int) -> Pupil:
    """Return the pupil of an SCA in a band, its cells binned."""
    return _pupil(sca, "long" if band in roman_psfs.longwave_bands else "short", pupil_bin)


@lru_cache(maxsize=1)
@_one_thread
def _pupil(sca: int, kind: str, pupil_bin: int) -> Pupil:
    # the cells are those of any wavelength
    aperture = roman_psfs._make_aperture(sca, kind, pupil_bin, roman_psfs.zemax_wavelength, None)
    return Pupil(
        aperture.npix,
        aperture.pupil_plane_scale,
        galsim.roman.diameter / 2,
        aperture.u_illuminated,
        aperture.v_illuminated,
    )


@lru_cache(maxsize=18)
def _aberrations(sca: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return roman_psfs._read_aberrations(sca)


@lru_cache(maxsize=128)
def edges(sca: int, band: str, n_waves: int, diffusion: float) -> dict[int, float]:
    """Return how bright a unit star is at the edges of stamps: the brighter of the band's ends."""
    waves, grid = roman_bandpass(band, n_waves).nodes, Grid(PSF_EXTENT_PIXELS // 8, BANDS[band].frequency_folds)
    return edge_brightness(transforms(sca, band, waves[[0, -1]], 8, MIDDLE, grid, diffusion), grid)


@lru_cache(maxsize=1)
@_one_thread
def over_sca(sca: int, band: str, n_waves: int, degree: int, diffusion: float) -> PsfModel:
    """Return the PSF of an SCA and band, as it varies over the SCA by polynomials of a degree; 0: it does not."""
    waves, lens = roman_bandpass(band, n_waves).nodes, pupil(sca, band, 8)
    grid, core = Grid(PSF_EXTENT_PIXELS // 8, BANDS[band].frequency_folds), Grid(CORE, BANDS[band].frequency_folds)
    places = place_grid((ACTIVE_PIXELS, ACTIVE_PIXELS), degree) if degree else np.empty((0, 2))
    nodes = transforms(sca, band, waves, 8, MIDDLE, grid, diffusion)
    differences = np.empty((n_waves, len(places), *core.shape), np.complex64)
    middle = grid.within(nodes, core.size)
    for node, wave in enumerate(waves):
        near = diffraction(lens, wave, core, galsim.roman.pixel_scale, diffusion)
        for number, place in enumerate(places):
            differences[node, number] = near.transform(aberrations(sca, wave, tuple(place))) - middle[node]
    return model(nodes, grid, Variation((ACTIVE_PIXELS, ACTIVE_PIXELS), degree, differences) if degree else None)


@dataclass(frozen=True)
class WideNodes:
    """The PSFs of a finer pupil, one after another, in the middle of an SCA."""

    sca: int
    band: str
    waves: tuple[float, ...]
    """nm"""
    pupil_bin: int
    grid: Grid
    diffusion: float

    def __call__(self) -> Iterator[np.ndarray]:
        """Yield their transforms (grid.shape)."""
        samples, size = _wide_samples(self), int(np.prod(self.grid.shape))
        for number in range(len(self.waves)):
            # another thread may read the same file
            with _ALONE:
                samples.file.seek(number * size * np.dtype(np.complex64).itemsize)
                one = np.fromfile(samples.file, np.complex64, size)
            yield one.reshape(self.grid.shape)


class _Samples:
    """Transforms one after another in a file without a name, which ends with this, or with the worker."""

    def __init__(self) -> None:
        self.file = TemporaryFile(prefix="romandask-")

    def __del__(self) -> None:
        self.file.close()


@lru_cache(maxsize=2)
@_one_thread
def _wide_samples(nodes: WideNodes) -> _Samples:
    """Return the samples of some nodes: long in the making, and large."""
    samples = _Samples()
    for wave in nodes.waves:
        one = transforms(nodes.sca, nodes.band, np.array([wave]), nodes.pupil_bin, MIDDLE, nodes.grid, nodes.diffusion)
        one.tofile(samples.file)
    return samples
