"""Photon shooting of bright objects through GalSim's model of a silicon sensor: brighter-fatter effect, tree rings."""

from __future__ import annotations

from collections.abc import Callable

import galsim
import numpy as np

from romandask.kernels.rendering.galsim_engine import Cell, component_profile
from romandask.kernels.rendering.stamps import Scene

MIN_ELECTRONS = 5e4
"""Smallest flux, electrons, of objects drawn with the silicon model; the brightest pixel of such a star has some
thousands."""
MAX_PHOTONS = 2e7
"""Largest number of photons of an object; a photon of a brighter object, which is saturated anyway, stands for several
electrons."""
BOX = 64
"""Side, pixels, of the box around the centre of an object in which charge is traced; the wings have little charge."""
RECALCULATIONS = 50
"""Approximate number of times that the pixel boundaries are recalculated while the photons of an object arrive."""
TREE_RINGS = {"amplitude": 0.26, "period": 47.0}
"""Amplitude and period of the tree rings, pixels."""
TREE_RINGS_CENTRE = (-200.0, -200.0)
"""Centre of the tree rings, pixels: outside the corner of the detector nearest to the centre of its wafer."""


def through_silicon(
    scene: Scene,
    chosen: np.ndarray,
    sizes: np.ndarray,
    psfs: Callable[[float, float], tuple[Cell, list[galsim.GSObject]]],
    waves: np.ndarray,
    shape: tuple[int, int],
    pixel_scale: float,
    seed: Callable[[int], int],
) -> np.ndarray:
    """Return the image of objects after the silicon model, with the Poisson noise of their photons.

    Charge diffusion and the width of the converging beam in the silicon are part of the camera's contribution to the
    PSF, and are not added again.

    Parameters
    ----------
    scene : Scene
        Objects.
    chosen : int array, shape (k,)
        Indices of the objects to draw, in the order in which their photons arrive.
    sizes : int array, shape (n,), pixels
        Sides of the stamps; photons outside the stamp are dropped.
    psfs : callable
        Function of a pixel position x, y that returns the cell of the position and the PSFs of the cell, in arcsec, one
        per node.
    waves : array, shape (nodes,), nm
        Wavelengths of the nodes.
    shape : (int, int)
        Shape of the image (ny, nx).
    pixel_scale : float, arcsec
        Pixel scale.
    seed : callable
        Function of the index of an object that returns the seed of its photons.

    Returns
    -------
    float32 array, shape (ny, nx), electrons
        Image.
    """
    image = galsim.ImageD(shape[1], shape[0], xmin=0, ymin=0, scale=1.0)
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    rings = galsim.SiliconSensor.simple_treerings(TREE_RINGS["amplitude"], TREE_RINGS["period"])
    for n in chosen.tolist():
        random = galsim.BaseDeviate(seed(n))
        _, nodes = psfs(scene.x[n], scene.y[n])
        components = range(first[n], first[n + 1])
        total = float(scene.photons[components.start : components.stop].sum())
        centre = galsim.PositionI(int(round(scene.x[n])), int(round(scene.y[n])))
        box = _square(centre, BOX) & image.bounds
        stamp = _square(centre, int(sizes[n])) & image.bounds
        if not stamp.isDefined():
            continue
        sensor = galsim.SiliconSensor(
            rng=random,
            nrecalc=max(1e4, total / RECALCULATIONS),
            treering_func=rings,
            treering_center=galsim.PositionD(*TREE_RINGS_CENTRE),
            diffusion_factor=0,
        )
        for node, (psf, wave) in enumerate(zip(nodes, waves, strict=True)):
            photons = _photons(scene, components, node, psf.dilate(1 / pixel_scale), total, random)
            if photons is None:
                continue
            photons.x += scene.x[n]
            photons.y += scene.y[n]
            photons.wavelength = np.full(len(photons), wave)
            inside = np.zeros(len(photons), bool)
            if box.isDefined():
                inside = (abs(photons.x - box.center.x) < BOX / 2) & (abs(photons.y - box.center.y) < BOX / 2)
                sensor.accumulate(_select(photons, inside), image[box], orig_center=galsim.PositionI(0, 0))
            _select(photons, ~inside).addTo(image[stamp])
    return image.array.astype(np.float32)


def _square(centre: galsim.PositionI, side: int) -> galsim.BoundsI:
    """Return the bounds of a square around a pixel."""
    low_x, low_y = centre.x - side // 2, centre.y - side // 2
    return galsim.BoundsI(low_x, low_x + side - 1, low_y, low_y + side - 1)


def _photons(
    scene: Scene, components: range, node: int, psf: galsim.GSObject, total: float, random: galsim.BaseDeviate
) -> galsim.PhotonArray | None:
    """Return the photons of one object at one node, in pixels from its centre; None if there are none."""
    profiles = []
    for c in components:
        flux = float(scene.photons[c, node])
        if flux > 0:
            source = component_profile(scene, n=int(scene.owner[c]), c=c)
            profiles.append((psf if source is None else galsim.Convolve(source, psf)) * flux)
    if not profiles:
        return None
    profile = galsim.Sum(profiles)
    electrons_per_photon = max(1.0, total / MAX_PHOTONS)
    count = galsim.PoissonDeviate(random, mean=profile.flux / electrons_per_photon)()
    if not count:
        return None
    photons = profile.makePhot(n_photons=int(count), rng=random, poisson_flux=False)
    photons.flux = np.full(len(photons), electrons_per_photon)
    return photons


def _select(photons: galsim.PhotonArray, chosen: np.ndarray) -> galsim.PhotonArray:
    """Return the chosen photons."""
    return galsim.PhotonArray(
        int(chosen.sum()),
        x=photons.x[chosen],
        y=photons.y[chosen],
        flux=photons.flux[chosen],
        wavelength=photons.wavelength[chosen],
    )
