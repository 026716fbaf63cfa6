"""From truth rows to a scene on an image: positions, shapes, lensing and photons in pixels and electrons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.kernels.photometry import Dust, Spectra, no_dust, node_photons
from romandask.kernels.render import DEVAUCOULEURS, EXPONENTIAL, KNOTS, POINT, Scene
from romandask.model.spectra import Bandpass, LibrarySpectra, SpectrumLibrary, TophatSpectra

COMPONENTS = ("bulge", "disk", "knots")


@dataclass(frozen=True)
class Truth:
    """Rows of the truth catalogs near one image, with the spectra they refer to."""

    galaxies: pd.DataFrame
    stars: pd.DataFrame
    galaxy_spectra: dict[str, Spectra]
    """By component."""
    star_spectra: Spectra
    internal_frame: str
    """"rest" or "observed": where the galaxies' own dust acts."""


def bind(
    galaxies: pd.DataFrame, stars: pd.DataFrame, library: SpectrumLibrary, edges: tuple[float, ...], frame: str
) -> Truth:
    """Return rows together with the spectra they refer to."""
    return Truth(
        galaxies,
        stars,
        {component: component_spectra(galaxies, component, library, edges) for component in COMPONENTS},
        LibrarySpectra(library, stars["sed"].to_numpy(int)),
        frame,
    )


def component_spectra(
    galaxies: pd.DataFrame, component: str, library: SpectrumLibrary, edges: tuple[float, ...]
) -> Spectra:
    """Return the spectra of a component: top-hats where the rows hold any, else those of the library."""
    bins = galaxies[f"sed_val_{component}"]
    if not any(len(row) for row in bins):
        return LibrarySpectra(library, galaxies[f"{component}_sed"].to_numpy(int))
    # a component without light may have no spectrum
    dark = np.zeros(len(edges) - 1)
    return TophatSpectra(np.stack([row if len(row) else dark for row in bins]).astype(float), np.array(edges))


def magnification(galaxies: pd.DataFrame) -> np.ndarray:
    """Return mu = 1 / ((1 - kappa)^2 - gamma^2) of each galaxy."""
    shear2 = galaxies["shear_1"] ** 2 + galaxies["shear_2"] ** 2
    return (1 / ((1 - galaxies["convergence"]) ** 2 - shear2)).to_numpy(float)


def galaxy_photons(truth: Truth, bandpass: Bandpass, component: str) -> np.ndarray:
    """Return photons per second (n, nodes) of one component of the galaxies, lensing magnification included."""
    rows = truth.galaxies
    dust = "bulge" if component == "bulge" else "disk"
    photons = node_photons(
        rows[f"{component}_magnorm"].to_numpy(float),
        truth.galaxy_spectra[component],
        rows["redshift"].to_numpy(float),
        Dust(rows[f"{dust}_av"].to_numpy(float), rows[f"{dust}_rv"].to_numpy(float)),
        Dust(rows["MW_av"].to_numpy(float), rows["MW_rv"].to_numpy(float)),
        bandpass,
        truth.internal_frame,
    )
    return photons * magnification(rows)[:, None]


def star_photons(truth: Truth, bandpass: Bandpass) -> np.ndarray:
    """Return photons per second (n, nodes) of the stars."""
    rows = truth.stars
    return node_photons(
        rows["magnorm"].to_numpy(float),
        truth.star_spectra,
        np.zeros(len(rows)),
        no_dust(len(rows)),
        Dust(rows["MW_av"].to_numpy(float), rows["MW_rv"].to_numpy(float)),
        bandpass,
    )


def shape_matrices(galaxies: pd.DataFrame, component: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 2, 2) from a round profile of half-light radius 1 to the sky, unlensed, and the lensing itself.

    The sky frame is GalSim's, (west, north) in arcsec: a position angle p east of north is the direction p + 90 deg
    from west through north, and (shear_1, shear_2) are GalSim's on-sky components. The half-light radius is sqrt(a b).
    """
    size = "bulge" if component == "bulge" else "disk"
    major = galaxies[f"size_{size}_true"].to_numpy(float)
    minor = galaxies[f"size_minor_{size}_true"].to_numpy(float)
    angle = np.radians(90.0 + galaxies["position_angle_unlensed"].to_numpy(float))
    rotation = np.stack(
        [np.stack([np.cos(angle), -np.sin(angle)], -1), np.stack([np.sin(angle), np.cos(angle)], -1)], -2
    )
    shape = (rotation * np.stack([major, minor], -1)[:, None, :]) @ rotation.transpose(0, 2, 1)
    kappa = galaxies["convergence"].to_numpy(float)
    g1, g2 = (galaxies[name].to_numpy(float) / (1 - kappa) for name in ("shear_1", "shear_2"))
    # area grows by mu, axis ratio changes by the reduced shear: inverse of [[1 - g1, -g2], [-g2, 1 + g1]] (1 - kappa)
    lens = np.stack([np.stack([1 + g1, g2], -1), np.stack([g2, 1 - g1], -1)], -2)
    lens /= ((1 - g1**2 - g2**2) * (1 - kappa))[:, None, None]
    return shape, lens


def pixel_positions(wcs: WCS, ra, dec) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixel x, y (0 at the first pixel's centre) and the local matrix (n, 2, 2) from (west, north) to pixels.

    Positions that the WCS cannot reach (the other side of the sky) are NaN.
    """
    ra, dec = np.atleast_1d(np.asarray(ra, float)), np.atleast_1d(np.asarray(dec, float))
    if not len(ra):
        return np.empty(0), np.empty(0), np.empty((0, 2, 2))
    x, y = wcs.all_world2pix(ra, dec, 0, quiet=True)
    corners = np.concatenate([np.stack([x + dx, y + dy]) for dx, dy in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))], 1)
    lon, lat = wcs.all_pix2world(corners[0], corners[1], 0)
    lon, lat = lon.reshape(4, -1), lat.reshape(4, -1)

    def west_north(a: int, b: int) -> np.ndarray:
        west = -((lon[a] - lon[b] + 180) % 360 - 180) * np.cos(np.radians(dec))
        return np.stack([west, lat[a] - lat[b]], -1) * 3600

    jacobian = np.stack([west_north(0, 1), west_north(2, 3)], -1)
    return x, y, np.linalg.inv(jacobian)


def build_scene(truth: Truth, wcs: WCS, bandpass: Bandpass, exptime: float, knot_smoothing: float) -> Scene:
    """Return the scene of an image.

    Parameters
    ----------
    exptime : seconds (electrons = photons per second times this)
    knot_smoothing : sigma, arcsec, of the Gaussian that smooths each knot before lensing; 0 for none
    """
    galaxies, stars = truth.galaxies, truth.stars
    x, y, to_pixels = pixel_positions(wcs, np.r_[galaxies["ra"], stars["ra"]], np.r_[galaxies["dec"], stars["dec"]])
    n, m = len(galaxies), len(stars)
    parts = [_Part(np.arange(n, n + m), POINT, np.zeros((m, 2, 2)), star_photons(truth, bandpass))]
    kinds = {"bulge": DEVAUCOULEURS, "disk": EXPONENTIAL, "knots": KNOTS}
    for component in COMPONENTS:
        shape, lens = shape_matrices(galaxies, component)
        photons = galaxy_photons(truth, bandpass, component)
        rows = np.flatnonzero(photons.sum(axis=1) > 0)
        parts.append(_Part(rows, kinds[component], (to_pixels[:n] @ lens @ shape)[rows], photons[rows]))
        if component == "knots":
            smoothing = (to_pixels[:n] @ lens)[rows] * knot_smoothing
            counts = galaxies["n_knots"].fillna(0).to_numpy(int)[rows]
    owner = np.concatenate([part.owner for part in parts])
    order = np.argsort(owner, kind="stable")
    blank = sum(len(part.owner) for part in parts[:-1])
    return Scene(
        x=x,
        y=y,
        key=np.r_[galaxies["galaxy_id"].to_numpy(np.int64), stars["id"].to_numpy(np.int64)].astype(np.uint64),
        owner=owner[order],
        kind=np.concatenate([np.full(len(part.owner), part.kind) for part in parts])[order],
        matrix=np.concatenate([part.matrix for part in parts])[order],
        smoothing=np.concatenate([np.zeros((blank, 2, 2)), smoothing])[order],
        knots=np.concatenate([np.zeros(blank, int), counts])[order],
        photons=(np.concatenate([part.photons for part in parts]) * exptime)[order],
    )


@dataclass(frozen=True)
class _Part:
    owner: np.ndarray
    kind: int
    matrix: np.ndarray
    photons: np.ndarray
