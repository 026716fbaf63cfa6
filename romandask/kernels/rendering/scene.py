"""From truth rows to a scene on an image: positions, shapes, lensing and photons in pixels and electrons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.kernels.rendering.draw import Scene
from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL, KNOTS, POINT
from romandask.kernels.universe.dust import Dust, no_dust
from romandask.kernels.universe.synthetic_photometry import Spectra, node_photons
from romandask.model.spectra import Bandpass, LibrarySpectra, SpectrumLibrary, TophatSpectra

COMPONENTS = ("bulge", "disk", "knots")


DRAWN = ""
NO_PLACE = "position that the image's WCS cannot reach"
BAD_SIZE = "size that is not a positive number"
BAD_LENSING = "shear and convergence beyond weak lensing, or not numbers"
BAD_FLUX = "flux that is not a number or overflows"
NO_LIGHT = "no light in this band"
OFF_IMAGE = "no light on the image"
"""Why an object is not drawn."""
MOST_FLUX = 1e15
"""Electrons, beyond which the image could not hold an object with any precision."""


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


@dataclass(frozen=True)
class Drawable:
    """The objects of a truth that can be drawn on an image, and why the others cannot."""

    scene: Scene
    rows: np.ndarray
    """(n,) which of the truth's objects, galaxies before stars, each of the scene is; ascending."""
    reasons: np.ndarray
    """(all objects of the truth,) DRAWN where an object is in the scene, else why it is not; object dtype."""
    x: np.ndarray
    """(all objects,) pixel coordinate, 0 at the centre of the first pixel; NaN where the WCS has none."""
    y: np.ndarray
    """(all objects,)"""


def build_scene(
    truth: Truth,
    wcs: WCS,
    bandpass: Bandpass,
    exptime: float,
    knot_smoothing: float,
    within: tuple[tuple[int, int], float] | None = None,
) -> Drawable:
    """Return the scene of an image.

    Parameters
    ----------
    exptime : seconds (electrons = photons per second times this)
    knot_smoothing : sigma, arcsec, of the Gaussian that smooths each knot before lensing; 0 for none
    within : shape of the image, and how far, pixels, from it objects are kept; None for all

    Objects that cannot be drawn are left out, each with a reason: no value of theirs reaches a pixel.
    """
    galaxies, stars = truth.galaxies, truth.stars
    n = len(galaxies)
    ra, dec = np.r_[galaxies["ra"], stars["ra"]].astype(float), np.r_[galaxies["dec"], stars["dec"]].astype(float)
    x, y, to_pixels = pixel_positions(wcs, ra, dec)
    reasons = np.full(len(ra), DRAWN, object)
    reasons[:n] = _galaxy_faults(galaxies)
    placed = np.isfinite(x) & np.isfinite(y) & np.isfinite(to_pixels).all(axis=(1, 2))
    reasons[~placed] = NO_PLACE
    if within is not None:
        (ny, nx), reach = within
        with np.errstate(invalid="ignore"):
            near = (x > -reach) & (x < nx + reach) & (y > -reach) & (y < ny + reach)
        reasons[placed & ~near & (reasons == DRAWN)] = OFF_IMAGE
    kept = np.flatnonzero(reasons == DRAWN)
    truth = _rows_of(truth, kept[kept < n], kept[kept >= n] - n)
    parts = _components(truth, bandpass, exptime, to_pixels[kept], knot_smoothing)
    # before the sum over components, which would hide what is not a number
    flux, good = np.zeros(len(kept)), np.ones(len(kept), bool)
    for part in parts:
        own = part.photons.sum(axis=1)
        flux[part.owner] += np.where(np.isfinite(own), own, 0)
        good[part.owner] &= np.isfinite(own)
    good &= flux < MOST_FLUX
    reasons[kept[~good]] = BAD_FLUX
    reasons[kept[good & ~(flux > 0)]] = NO_LIGHT
    lit = np.flatnonzero(good & (flux > 0))
    place = np.full(len(kept), -1)
    place[lit] = np.arange(len(lit))
    owner = np.concatenate([place[part.owner] for part in parts])
    used = np.flatnonzero(owner >= 0)
    order = used[np.argsort(owner[used], kind="stable")]
    key = np.r_[truth.galaxies["galaxy_id"].to_numpy(np.int64), truth.stars["id"].to_numpy(np.int64)]
    rows = kept[lit]
    scene = Scene(
        x=x[rows],
        y=y[rows],
        key=key.astype(np.uint64)[lit],
        owner=owner[order],
        kind=np.concatenate([np.full(len(part.owner), part.kind) for part in parts])[order],
        matrix=np.concatenate([part.matrix for part in parts])[order],
        smoothing=np.concatenate([part.smoothing for part in parts])[order],
        knots=np.concatenate([part.knots for part in parts])[order],
        photons=np.concatenate([part.photons for part in parts])[order],
    )
    return Drawable(scene, rows, reasons, x, y)


def _galaxy_faults(galaxies: pd.DataFrame) -> np.ndarray:
    """Return why galaxies cannot be drawn; a size counts where its component has light."""
    reasons = np.full(len(galaxies), DRAWN, object)
    for component in COMPONENTS:
        size = "bulge" if component == "bulge" else "disk"
        lit = np.isfinite(galaxies[f"{component}_magnorm"].to_numpy(float))
        for name in (f"size_{size}_true", f"size_minor_{size}_true", "position_angle_unlensed"):
            values = galaxies[name].to_numpy(float)
            good = np.isfinite(values) & ((values > 0) | (name == "position_angle_unlensed"))
            reasons[lit & ~good] = BAD_SIZE
    kappa, g1, g2 = (galaxies[name].to_numpy(float) for name in ("convergence", "shear_1", "shear_2"))
    with np.errstate(invalid="ignore"):
        reasons[~((kappa < 1) & (np.hypot(g1, g2) < 1 - kappa))] = BAD_LENSING
    return reasons


def _components(
    truth: Truth, bandpass: Bandpass, exptime: float, to_pixels: np.ndarray, knot_smoothing: float
) -> list[_Part]:
    """Return the lit components of galaxies and stars; owners count galaxies before stars."""
    n, m = len(truth.galaxies), len(truth.stars)
    with np.errstate(over="ignore"):
        light = star_photons(truth, bandpass) * exptime
    points = np.zeros((m, 2, 2))
    parts = [_Part(np.arange(n, n + m), POINT, points, points, np.zeros(m, int), light)]
    kinds = {"bulge": DEVAUCOULEURS, "disk": EXPONENTIAL, "knots": KNOTS}
    for component in COMPONENTS:
        shape, lens = shape_matrices(truth.galaxies, component)
        with np.errstate(over="ignore", invalid="ignore"):
            photons = galaxy_photons(truth, bandpass, component) * exptime
            rows = np.flatnonzero(~(photons.sum(axis=1) <= 0))
        smoothing, counts = np.zeros((len(rows), 2, 2)), np.zeros(len(rows), int)
        if component == "knots":
            smoothing = (to_pixels[:n] @ lens)[rows] * knot_smoothing
            counts = truth.galaxies["n_knots"].fillna(0).to_numpy(int)[rows]
        matrix = (to_pixels[:n] @ lens @ shape)[rows]
        parts.append(_Part(rows, kinds[component], matrix, smoothing, counts, photons[rows]))
    return parts


def _rows_of(truth: Truth, galaxies: np.ndarray, stars: np.ndarray) -> Truth:
    """Return some galaxies and stars of a truth."""
    return Truth(
        truth.galaxies.iloc[galaxies],
        truth.stars.iloc[stars],
        {component: spectra.rows(galaxies) for component, spectra in truth.galaxy_spectra.items()},
        truth.star_spectra.rows(stars),
        truth.internal_frame,
    )


@dataclass(frozen=True)
class _Part:
    owner: np.ndarray
    kind: int
    matrix: np.ndarray
    smoothing: np.ndarray
    knots: np.ndarray
    photons: np.ndarray
