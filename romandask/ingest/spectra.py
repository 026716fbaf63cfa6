"""Libraries of spectra: GalSim's CWW templates, blackbodies, and folders of text files (nm, f_lambda)."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import astropy.units as u
import galsim
import h5py
import numpy as np
from astropy.modeling.physical_models import BlackBody

from romandask.ingest.rows import NEGATIVE, NO_LIGHT, NOT_A_NUMBER
from romandask.model.errors import UserError
from romandask.model.spectra import MAGNORM_WAVE, SpectrumLibrary, default_grid, library_from
from romandask.storage.paths import AnyPath, local_copy

BLACKBODY = re.compile(r"blackbody_(\d{3,6})")
"""Names of blackbodies; the number is the temperature, K."""
FLAT_FNU = "flat_fnu"
"""Name of the spectrum with constant f_nu above the Lyman limit.

It stands for the bluest galaxies (UV slope -2, Bouwens et al. 2009), which are bluer than all templates of Coleman, Wu
and Weedman.
"""
_LYMAN_LIMIT = 91.2
"""Wavelength, nm."""


def galaxy_templates(names: tuple[str, ...], steps: int) -> SpectrumLibrary:
    """Return galaxy templates and blends of neighbouring templates.

    The templates are GalSim's (Coleman, Wu and Weedman 1980, extended) and `FLAT_FNU`. Blends are linear in photons,
    with both templates normalised at 500 nm.

    Parameters
    ----------
    names : tuple of str
        Names of the templates, in the order in which neighbours are blended.
    steps : int
        Number of steps from each template to the next, with `steps` - 1 blends between them.
    """
    grid = default_grid()
    spectra = []
    for name in names:
        if name == FLAT_FNU:
            spectra.append((grid, np.where(grid > _LYMAN_LIMIT, grid**-2.0, 0.0)))
            continue
        angstrom, flambda = np.loadtxt(Path(galsim.meta_data.share_dir) / "SEDs" / f"{name}_ext_more.sed", unpack=True)
        spectra.append((angstrom / 10, flambda))
    pure = library_from(list(names), spectra, grid)
    labels, rows = [], []
    for k in range((len(names) - 1) * steps + 1):
        first, step = divmod(k, steps)
        labels.append(names[first] if step == 0 else f"{names[first]}+{step}/{steps}")
        second = min(first + 1, len(names) - 1)
        rows.append(pure.photons[first] * (1 - step / steps) + pure.photons[second] * (step / steps))
    limits = np.tile([grid[0], grid[-1]], (len(rows), 1))
    return SpectrumLibrary(tuple(labels), grid, np.array(rows), limits)


def blackbodies(temperatures: tuple[int, ...]) -> SpectrumLibrary:
    """Return blackbodies of the given temperatures, K, named blackbody_<K>."""
    grid = default_grid()
    scale = 1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr)
    spectra = [(grid, BlackBody(value * u.K, scale=scale)(grid * u.nm).value) for value in temperatures]
    return library_from([f"blackbody_{value}" for value in temperatures], spectra, grid)


def joined(*libraries: SpectrumLibrary) -> SpectrumLibrary:
    """Return one library with the spectra of several, which must have the same wavelength grid."""
    return SpectrumLibrary(
        tuple(name for library in libraries for name in library.names),
        libraries[0].wave,
        np.concatenate([library.photons for library in libraries]),
        np.concatenate([library.limits for library in libraries]),
    )


def every_file(folder: AnyPath) -> list[str]:
    """Return the paths of all files below a folder of spectra, relative to it.

    Raises
    ------
    UserError
        If there is no such folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder of spectra")
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def read_folder(folder: AnyPath, names: list[str]) -> tuple[SpectrumLibrary, dict[str, str]]:
    """Return a library of the spectra with the given names.

    Parameters
    ----------
    folder : path
        Folder of text files, plain or .gz, with the columns wavelength (nm) and f_lambda; or the file seds.hdf5 of
        `romandask export truth`.
    names : list of str
        Paths of files relative to the folder, or blackbody_<K> for a blackbody of that temperature, which needs no
        file.

    Returns
    -------
    library : SpectrumLibrary
        The spectra that could be read.
    reasons : dict
        Why a spectrum could not be read, by name.

    Raises
    ------
    UserError
        If there is no such folder and a name is not that of a blackbody, or the file is not as it was exported.
    """
    if folder.is_file():
        return _exported(folder, sorted(set(names)))
    if not folder.is_dir() and any(not BLACKBODY.fullmatch(name) for name in names):
        raise UserError(f"{folder}: no such folder; truth.seds must name the folder of spectra")
    labels, spectra, reasons = [], [], {}
    grid = default_grid()
    for name in sorted(set(names)):
        if match := BLACKBODY.fullmatch(name):
            labels.append(name)
            spectra.append((grid, blackbodies((int(match.group(1)),)).photons[0] / grid))
            continue
        path = (folder / name).resolve()
        if not path.is_relative_to(folder.resolve()):
            reasons[name] = "SED path leads out of the library"
            continue
        if not path.is_file():
            reasons[name] = "SED not in the library"
            continue
        try:
            local = local_copy(path)
            # a byte-order mark at the beginning is left out
            with (
                gzip.open(local, "rt", encoding="utf-8-sig")
                if local.suffix == ".gz"
                else open(local, encoding="utf-8-sig") as file
            ):
                wave, flambda = np.loadtxt(file, unpack=True, ndmin=2)[:2]
        except (OSError, EOFError, ValueError):
            reasons[name] = "SED file cannot be read"
            continue
        if fault := _fault(wave, flambda):
            reasons[name] = fault
            continue
        labels.append(name)
        spectra.append((wave, flambda))
    return library_from(labels, spectra, grid), reasons


def _fault(wave: np.ndarray, flambda: np.ndarray) -> str:
    """Return why a spectrum cannot be used, or ""."""
    if not (np.isfinite(wave).all() and np.isfinite(flambda).all()):
        return "SED file: " + NOT_A_NUMBER
    if (wave <= 0).any() or (np.diff(wave) < 0).any():
        return "SED file: wavelengths do not increase"
    if (flambda < 0).any():
        return "SED file: " + NEGATIVE
    if not wave[0] < MAGNORM_WAVE < wave[-1]:
        return "SED file: " + NO_LIGHT
    try:
        library_from([""], [(wave, flambda)], np.array([400.0, 500.0]))
    except ValueError:
        return "SED file: " + NO_LIGHT
    return ""


def _exported(path: AnyPath, names: list[str]) -> tuple[SpectrumLibrary, dict[str, str]]:
    """Return a library of the spectra with the given names in an exported HDF5 file, and why others cannot be read."""
    try:
        with h5py.File(local_copy(path)) as file:
            wave, limits = file["wave"][:], file["limits"][:]
            known = {name: row for row, name in enumerate(file["name"].asstr()[:])}
            found = [name for name in names if name in known]
            flambda = np.array([file["flambda"][known[name]] for name in found]).reshape(len(found), len(wave))
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise UserError(
            f"{path}: not a file of spectra as `romandask export truth` writes it ({error}): name a folder of spectra"
        ) from None
    grid = default_grid()
    if wave.shape != grid.shape or not np.allclose(wave, grid, rtol=1e-9):
        raise UserError(f"{path}: data set wave is not romandask's grid: export the truth again")
    rows = [known[name] for name in found]
    reasons = {name: "SED not in the library" for name in names if name not in known}
    return SpectrumLibrary(tuple(found), grid, flambda * (grid / MAGNORM_WAVE), limits[rows].reshape(-1, 2)), reasons
