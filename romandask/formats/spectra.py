"""Spectra from files: GalSim's CWW templates, blackbodies, and folders of text spectra (nm, f_lambda)."""

from __future__ import annotations

import gzip
from pathlib import Path

import astropy.units as u
import galsim
import numpy as np
from astropy.modeling.physical_models import BlackBody

from romandask.model.errors import UserError
from romandask.model.spectra import SpectrumLibrary, default_grid, library_from


def templates(galaxies: tuple[str, ...], temperatures: tuple[int, ...]) -> SpectrumLibrary:
    """Return GalSim's galaxy templates (Coleman, Wu and Weedman 1980, extended) and blackbodies, in this order."""
    grid = default_grid()
    names, spectra = [], []
    for name in galaxies:
        angstrom, flambda = np.loadtxt(Path(galsim.meta_data.share_dir) / "SEDs" / f"{name}_ext_more.sed", unpack=True)
        names.append(name)
        spectra.append((angstrom / 10, flambda))
    for temperature in temperatures:
        body = BlackBody(temperature * u.K, scale=1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr))
        names.append(f"blackbody_{temperature}")
        spectra.append((grid, body(grid * u.nm).value))
    return library_from(names, spectra, grid)


def read_folder(folder: Path, names: list[str]) -> tuple[SpectrumLibrary, dict[str, str]]:
    """Return a library of the named spectra (paths below the folder) and, by name, why others are not in it."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; truth.seds must name the folder of spectra")
    found, spectra, reasons = [], [], {}
    for name in sorted(set(names)):
        path = (folder / name).resolve()
        if not path.is_relative_to(folder.resolve()):
            reasons[name] = "SED path leads out of the library"
            continue
        if not path.is_file():
            reasons[name] = "SED not in the library"
            continue
        try:
            with gzip.open(path, "rt") if path.suffix == ".gz" else open(path) as file:
                wave, flambda = np.loadtxt(file, unpack=True)[:2]
            library_from([name], [(wave, flambda)], np.array([400.0, 500.0]))
        except (OSError, EOFError, ValueError):
            reasons[name] = "SED file cannot be read"
            continue
        found.append(name)
        spectra.append((wave, flambda))
    return library_from(found, spectra, default_grid()), reasons
