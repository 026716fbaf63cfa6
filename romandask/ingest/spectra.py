"""Spectra from files: GalSim's CWW templates, blackbodies, and folders of text spectra (nm, f_lambda)."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import astropy.units as u
import galsim
import numpy as np
from astropy.modeling.physical_models import BlackBody

from romandask.model.errors import UserError
from romandask.model.spectra import SpectrumLibrary, default_grid, library_from
from romandask.storage.paths import AnyPath, local_copy

BLACKBODY = re.compile(r"blackbody_(\d{3,6})")
YOUNG = "flat_fnu"
"""Name of a spectrum of constant f_nu above the Lyman limit: the bluest galaxies (UV slope -2, Bouwens et al. 2009),
which Coleman, Wu and Weedman's templates do not reach."""
_LYMAN_LIMIT = 91.2


def galaxy_templates(names: tuple[str, ...], steps: int) -> SpectrumLibrary:
    """Return GalSim's galaxy templates (Coleman, Wu and Weedman 1980, extended) and YOUNG, and blends of neighbours.

    From each template to the next are `steps` spectra; blends are linear in photons, both normalised at 500 nm.
    """
    grid = default_grid()
    spectra = []
    for name in names:
        if name == YOUNG:
            spectra.append((grid, np.where(grid > _LYMAN_LIMIT, grid**-2.0, 0.0)))
            continue
        angstrom, flambda = np.loadtxt(Path(galsim.meta_data.share_dir) / "SEDs" / f"{name}_ext_more.sed", unpack=True)
        spectra.append((angstrom / 10, flambda))
    pure = library_from(list(names), spectra, grid)
    labels, rows = [], []
    for k in range((len(names) - 1) * steps + 1):
        one, share = divmod(k, steps)
        labels.append(names[one] if share == 0 else f"{names[one]}+{share}/{steps}")
        two = min(one + 1, len(names) - 1)
        rows.append(pure.photons[one] * (1 - share / steps) + pure.photons[two] * (share / steps))
    limits = np.tile([grid[0], grid[-1]], (len(rows), 1))
    return SpectrumLibrary(tuple(labels), grid, np.array(rows), limits)


def blackbodies(temperatures: tuple[int, ...]) -> SpectrumLibrary:
    """Return blackbodies, named blackbody_<K>."""
    grid = default_grid()
    scale = 1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr)
    spectra = [(grid, BlackBody(value * u.K, scale=scale)(grid * u.nm).value) for value in temperatures]
    return library_from([f"blackbody_{value}" for value in temperatures], spectra, grid)


def joined(*libraries: SpectrumLibrary) -> SpectrumLibrary:
    """Return one library of several on the same grid."""
    return SpectrumLibrary(
        tuple(name for library in libraries for name in library.names),
        libraries[0].wave,
        np.concatenate([library.photons for library in libraries]),
        np.concatenate([library.limits for library in libraries]),
    )


def every_file(folder: AnyPath) -> list[str]:
    """Return the files of a folder of spectra, by their paths below it."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder of spectra")
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def read_folder(folder: AnyPath, names: list[str]) -> tuple[SpectrumLibrary, dict[str, str]]:
    """Return a library of the named spectra (paths below the folder) and, by name, why others are not in it.

    blackbody_<K> is a blackbody of that temperature and needs no file.
    """
    if not folder.is_dir() and any(not BLACKBODY.fullmatch(name) for name in names):
        raise UserError(f"{folder}: no such folder; truth.seds must name the folder of spectra")
    found, spectra, reasons = [], [], {}
    grid = default_grid()
    for name in sorted(set(names)):
        if match := BLACKBODY.fullmatch(name):
            found.append(name)
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
            here = local_copy(path)
            with gzip.open(here, "rt") if here.suffix == ".gz" else open(here) as file:
                wave, flambda = np.loadtxt(file, unpack=True)[:2]
            library_from([name], [(wave, flambda)], np.array([400.0, 500.0]))
        except (OSError, EOFError, ValueError):
            reasons[name] = "SED file cannot be read"
            continue
        found.append(name)
        spectra.append((wave, flambda))
    return library_from(found, spectra, grid), reasons
