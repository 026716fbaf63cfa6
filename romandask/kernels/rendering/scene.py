"""Conversion of truth catalog rows to a scene on an image: positions and shapes in pixels, lensing, electrons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL, KNOTS, POINT
from romandask.kernels.rendering.profiles import light_radius
from romandask.kernels.rendering.stamps import Scene
from romandask.kernels.universe.dust import Dust, no_dust
from romandask.kernels.universe.synthetic_photometry import Spectra, node_photons
from romandask.model.spectra import Bandpass, LibrarySpectra, SpectrumLibrary, TophatSpectra

COMPONENTS = ("bulge", "disk", "knots")
"""Components of galaxies. Knots share the size and the dust of the disk."""

# reasons for which an object is not drawn; empty for one that is drawn
DRAWN = ""
NO_POSITION = "position that the image's WCS cannot reach"
BAD_SIZE = "size that is not a positive number"
BAD_LENSING = "shear and convergence beyond weak lensing, or not numbers"
BAD_FLUX = "flux that is not a number or overflows"
NO_LIGHT = "no light in this band"
OFF_IMAGE = "no light on the image"
MAX_FLUX = 1e15
"""Flux, electrons, from which on an object is not drawn, because the image would lose all precision."""


@dataclass(frozen=True)
class Truth:
    """Rows of the truth catalogs near one image, with their spectra."""

    galaxies: pd.DataFrame
    """Rows of catalogs/galaxies.yaml."""
    stars: pd.DataFrame
    """Rows of catalogs/stars.yaml."""
    galaxy_spectra: dict[str, Spectra]
    """Spectra of the galaxies, by component."""
    star_spectra: Spectra
    """Spectra of the stars."""
    internal_frame: str
    """Frame in which the internal dust of galaxies acts, "rest" or "observed"."""


def bind(
    galaxies: pd.DataFrame, stars: pd.DataFrame, library: SpectrumLibrary, edges: tuple[float, ...], frame: str
) -> Truth:
    """Return truth rows with their spectra.

    Parameters
    ----------
    galaxies, stars : pandas.DataFrame
        Rows of the truth catalogs.
    library : SpectrumLibrary
        Spectra that the rows refer to by index.
    edges : tuple of float, nm
        Rest-frame edges of the bins of top-hat spectra; empty if there are none.
    frame : {"rest", "observed"}
        Frame in which the internal dust of galaxies acts.
    """
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
    """Return the spectra of a component: top-hat spectra if any row has one, else library spectra.

    Parameters are those of `bind`.
    """
    bins = galaxies[f"sed_val_{component}"]
    if not any(len(row) for row in bins):
        return LibrarySpectra(library, galaxies[f"{component}_sed"].to_numpy(int))
    # a component without light may have no spectrum
    zeros = np.zeros(len(edges) - 1)
    return TophatSpectra(np.stack([row if len(row) else zeros for row in bins]).astype(float), np.array(edges))


def magnification(galaxies: pd.DataFrame) -> np.ndarray:
    """Return the lensing magnification mu = 1 / ((1 - kappa)^2 - gamma^2) of each galaxy."""
    shear2 = galaxies["shear_1"] ** 2 + galaxies["shear_2"] ** 2
    return (1 / ((1 - galaxies["convergence"]) ** 2 - shear2)).to_numpy(float)


def galaxy_photons(truth: Truth, bandpass: Bandpass, component: str) -> np.ndarray:
    """Return the photon rates of one component of the galaxies, with lensing magnification.

    Returns
    -------
    array, shape (galaxies, nodes), photons/s
        Photon rates at the PSF nodes of the band.
    """
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
    """Return the photon rates of the stars, shape (stars, nodes), photons/s, at the PSF nodes of a band."""
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
    """Return the linear maps of shape and lensing of one component of the galaxies.

    The sky frame is that of GalSim, (west, north) in arcsec. In this frame a position angle p, east of north, is the
    direction p + 90 deg from west through north, and (shear_1, shear_2) are GalSim's on-sky components. The half-light
    radius is sqrt(a b).

    Returns
    -------
    shape : array, shape (n, 2, 2)
        Map from a round profile of half-light radius 1 to the unlensed profile on the sky, arcsec.
    lens : array, shape (n, 2, 2)
        Map from the unlensed to the lensed sky.
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
    # inverse of (1 - kappa) [[1 - g1, -g2], [-g2, 1 + g1]], where (g1, g2) is the reduced shear; its determinant is mu
    lens = np.stack([np.stack([1 + g1, g2], -1), np.stack([g2, 1 - g1], -1)], -2)
    lens /= ((1 - g1**2 - g2**2) * (1 - kappa))[:, None, None]
    return shape, lens


def pixel_positions(wcs: WCS, ra, dec) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixel positions and the local linear maps from the sky to pixels.

    Parameters
    ----------
    wcs : astropy.wcs.WCS
        WCS of the image.
    ra, dec : array, shape (n,), degrees
        Positions.

    Returns
    -------
    x, y : array, shape (n,), pixels
        Positions, 0 at the centre of the first pixel; NaN where the WCS is not defined (the other side of the sky).
    to_pixels : array, shape (n, 2, 2)
        Maps from offsets (west, north) in arcsec to pixels.
    """
    ra, dec = np.atleast_1d(np.asarray(ra, float)), np.atleast_1d(np.asarray(dec, float))
    if not len(ra):
        return np.empty(0), np.empty(0), np.empty((0, 2, 2))
    x, y = wcs.all_world2pix(ra, dec, 0, quiet=True)
    corners = np.concatenate([np.stack([x + dx, y + dy]) for dx, dy in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))], 1)
    lon, lat = wcs.all_pix2world(corners[0], corners[1], 0)
    lon, lat = lon.reshape(4, -1), lat.reshape(4, -1)

    def west_north(a: int, b: int) -> np.ndarray:
        """Return the offset from corner b to corner a, arcsec."""
        west = -((lon[a] - lon[b] + 180) % 360 - 180) * np.cos(np.radians(dec))
        return np.stack([west, lat[a] - lat[b]], -1) * 3600

    jacobian = np.stack([west_north(0, 1), west_north(2, 3)], -1)
    return x, y, np.linalg.inv(jacobian)


@dataclass(frozen=True)
class Drawable:
    """The objects that can be drawn on an image, and the reasons for which others cannot.

    m is the number of all objects of the `Truth`, galaxies first, then stars; n is the number of objects of the scene.
    """

    scene: Scene
    rows: np.ndarray
    """Index among the m objects of each object of the scene, shape (n,), ascending."""
    reasons: np.ndarray
    """DRAWN for an object of the scene, else the reason why it is not drawn, shape (m,), object dtype."""
    x: np.ndarray
    """Pixel coordinate along x, 0 at the centre of the first pixel, shape (m,); NaN where the WCS is not defined."""
    y: np.ndarray
    """Pixel coordinate along y, as `x`."""


@dataclass(frozen=True)
class Within:
    """Distances from an image to which objects are kept."""

    shape: tuple[int, int]
    """Shape of the image (ny, nx)."""
    galaxies: float
    """Distance for galaxies, pixels; larger ones are kept as far as their light reaches."""
    stars: float
    """Distance for stars, pixels."""

    def contains(self, x: np.ndarray, y: np.ndarray, radius: np.ndarray, is_star: np.ndarray) -> np.ndarray:
        """Return a mask of the objects to keep, given their positions and radii, pixels, and whether they are stars."""
        (ny, nx), distance = self.shape, np.where(is_star, self.stars, np.fmax(self.galaxies, radius))
        with np.errstate(invalid="ignore"):
            return (x > -distance) & (x < nx + distance) & (y > -distance) & (y < ny + distance)


def _radii(galaxies: pd.DataFrame) -> np.ndarray:
    """Return radii, arcsec, that contain all but a thousandth of the light of galaxies."""
    radii = [np.zeros(len(galaxies))]
    for component, kind, size in (("bulge", DEVAUCOULEURS, "bulge"), ("disk", EXPONENTIAL, "disk")):
        lit = np.isfinite(galaxies[f"{component}_magnorm"].to_numpy(float))
        extent = light_radius(np.array([kind]), np.array([1e-3]))[0]
        radii.append(np.where(lit, extent * galaxies[f"size_{size}_true"].to_numpy(float), 0.0))
    return np.fmax.reduce(radii)


def build_scene(
    truth: Truth,
    wcs: WCS,
    bandpass: Bandpass,
    exptime: float,
    knot_smoothing: float,
    within: Within | None = None,
) -> Drawable:
    """Return the scene of an image.

    Objects that cannot be drawn are left out, each with a reason, so that no invalid value reaches a pixel.

    Parameters
    ----------
    truth : Truth
        Rows of the truth catalogs.
    wcs : astropy.wcs.WCS
        WCS of the image.
    bandpass : Bandpass
        Band.
    exptime : float, s
        Exposure time; electrons are photon rates times this.
    knot_smoothing : float, arcsec
        Sigma of the Gaussian that smooths each knot before lensing; 0 for no smoothing.
    within : Within, optional
        Where objects are kept; None to keep all.
    """
    galaxies, stars = truth.galaxies, truth.stars
    n = len(galaxies)
    ra, dec = np.r_[galaxies["ra"], stars["ra"]].astype(float), np.r_[galaxies["dec"], stars["dec"]].astype(float)
    x, y, to_pixels = pixel_positions(wcs, ra, dec)
    reasons = np.full(len(ra), DRAWN, object)
    reasons[:n] = _galaxy_faults(galaxies)
    has_position = np.isfinite(x) & np.isfinite(y) & np.isfinite(to_pixels).all(axis=(1, 2))
    reasons[~has_position] = NO_POSITION
    if within is not None:
        with np.errstate(invalid="ignore"):
            scale = np.sqrt(np.abs(np.linalg.det(to_pixels)))
        near = within.contains(x, y, np.r_[_radii(galaxies), np.zeros(len(stars))] * scale, np.arange(len(x)) >= n)
        reasons[has_position & ~near & (reasons == DRAWN)] = OFF_IMAGE
    kept = np.flatnonzero(reasons == DRAWN)
    truth = _rows_of(truth, kept[kept < n], kept[kept >= n] - n)
    parts = _components(truth, bandpass, exptime, to_pixels[kept], knot_smoothing)
    # each component is checked, because a sum over components could hide one that is not finite
    flux, good = np.zeros(len(kept)), np.ones(len(kept), bool)
    for part in parts:
        part_flux = part.photons.sum(axis=1)
        flux[part.owner] += np.where(np.isfinite(part_flux), part_flux, 0)
        good[part.owner] &= np.isfinite(part_flux)
    good &= flux < MAX_FLUX
    reasons[kept[~good]] = BAD_FLUX
    reasons[kept[good & ~(flux > 0)]] = NO_LIGHT
    lit = np.flatnonzero(good & (flux > 0))
    scene_index = np.full(len(kept), -1)
    scene_index[lit] = np.arange(len(lit))
    owner = np.concatenate([scene_index[part.owner] for part in parts])
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
    """Return the reason why each galaxy cannot be drawn; the size of a component counts only if it has light."""
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
    """Return the stars, and the components of the galaxies that have light."""
    n, m = len(truth.galaxies), len(truth.stars)
    with np.errstate(over="ignore"):
        photons = star_photons(truth, bandpass) * exptime
    zeros = np.zeros((m, 2, 2))
    stars = _Part(
        owner=np.arange(n, n + m),
        kind=POINT,
        matrix=zeros,
        smoothing=zeros,
        knots=np.zeros(m, int),
        photons=photons,
    )
    parts = [stars]
    kinds = {"bulge": DEVAUCOULEURS, "disk": EXPONENTIAL, "knots": KNOTS}
    for component in COMPONENTS:
        shape, lens = shape_matrices(truth.galaxies, component)
        with np.errstate(over="ignore", invalid="ignore"):
            photons = galaxy_photons(truth, bandpass, component) * exptime
            # keeps NaN, which is reported as BAD_FLUX later
            rows = np.flatnonzero(~(photons.sum(axis=1) <= 0))
        smoothing, knots = np.zeros((len(rows), 2, 2)), np.zeros(len(rows), int)
        if component == "knots":
            smoothing = (to_pixels[:n] @ lens)[rows] * knot_smoothing
            knots = truth.galaxies["n_knots"].fillna(0).to_numpy(int)[rows]
        part = _Part(
            owner=rows,
            kind=kinds[component],
            matrix=(to_pixels[:n] @ lens @ shape)[rows],
            smoothing=smoothing,
            knots=knots,
            photons=photons[rows],
        )
        parts.append(part)
    return parts


def _rows_of(truth: Truth, galaxies: np.ndarray, stars: np.ndarray) -> Truth:
    """Return the galaxies and the stars with some row numbers."""
    return Truth(
        truth.galaxies.iloc[galaxies],
        truth.stars.iloc[stars],
        {component: spectra.rows(galaxies) for component, spectra in truth.galaxy_spectra.items()},
        truth.star_spectra.rows(stars),
        truth.internal_frame,
    )


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Components of one kind, with the fields of `Scene`; `owner` counts the galaxies first, then the stars."""

    owner: np.ndarray
    kind: int
    matrix: np.ndarray
    smoothing: np.ndarray
    knots: np.ndarray
    photons: np.ndarray
