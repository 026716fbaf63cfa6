"""Bright objects of a CCD, photon by photon through GalSim's model of silicon: brighter-fatter, tree rings."""

from __future__ import annotations

from collections.abc import Callable

import galsim
import numpy as np

from romandask.kernels.rendering.draw import Scene
from romandask.kernels.rendering.galsim_engine import Place, component_profile

LEAST = 5e4
"""Electrons from which on an object goes through the silicon: the brightest pixel of a star has some thousands then."""
MOST = 2e7
"""Photons of an object at most: those of brighter ones, saturated in any case, stand for several electrons."""
BOX = 64
"""Side, pixels, of the part around an object's middle in which charge is followed; in its wings little is."""
STEPS = 50
"""Times that the shapes of pixels are worked out again while an object's photons come in, about."""
RINGS = {"amplitude": 0.26, "period": 47.0}
"""Of tree rings, pixels."""
RINGS_CENTRE = (-200.0, -200.0)
"""About the corner of a detector that the middle of its wafer is next to, pixels."""


def through_silicon(
    scene: Scene,
    chosen: np.ndarray,
    sizes: np.ndarray,
    psfs: Callable[[float, float], tuple[Place, list[galsim.GSObject]]],
    waves: np.ndarray,
    shape: tuple[int, int],
    pixel_scale: float,
    seed: Callable[[int], int],
) -> np.ndarray:
    """Return the electrons (float32, ny, nx) that some objects leave, the Poisson noise of their photons included.

    Diffusion of charge and the beam's width in the silicon belong to the PSF's part that is the camera's, and are not
    added again.

    Parameters
    ----------
    chosen : (k,) numbers of the objects, in the order in which their photons come
    sizes : (n,) of stamps, beyond which an object has no light
    psfs : gives for a pixel position the place whose PSFs are used there, and these PSFs (arcsec), one a node
    waves : (nodes,) wavelength, nm
    shape : (ny, nx)
    seed : gives the seed of an object's photons, by its number
    """
    image = galsim.ImageD(shape[1], shape[0], xmin=0, ymin=0, scale=1.0)
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    rings = galsim.SiliconSensor.simple_treerings(RINGS["amplitude"], RINGS["period"])
    for n in chosen.tolist():
        random = galsim.BaseDeviate(seed(n))
        _, nodes = psfs(scene.x[n], scene.y[n])
        parts = range(first[n], first[n + 1])
        total = float(scene.photons[parts.start : parts.stop].sum())
        centre = galsim.PositionI(int(round(scene.x[n])), int(round(scene.y[n])))
        box = _around(centre, BOX) & image.bounds
        stamp = _around(centre, int(sizes[n])) & image.bounds
        if not stamp.isDefined():
            continue
        sensor = galsim.SiliconSensor(
            rng=random,
            nrecalc=max(1e4, total / STEPS),
            treering_func=rings,
            treering_center=galsim.PositionD(*RINGS_CENTRE),
            diffusion_factor=0,
        )
        for node, (psf, wave) in enumerate(zip(nodes, waves, strict=True)):
            photons = _photons(scene, parts, node, psf.dilate(1 / pixel_scale), total, random)
            if photons is None:
                continue
            photons.x += scene.x[n]
            photons.y += scene.y[n]
            photons.wavelength = np.full(len(photons), wave)
            inside = np.zeros(len(photons), bool)
            if box.isDefined():
                inside = (abs(photons.x - box.center.x) < BOX / 2) & (abs(photons.y - box.center.y) < BOX / 2)
                sensor.accumulate(_some(photons, inside), image[box], orig_center=galsim.PositionI(0, 0))
            _some(photons, ~inside).addTo(image[stamp])
    return image.array.astype(np.float32)


def _around(centre: galsim.PositionI, side: int) -> galsim.BoundsI:
    low_x, low_y = centre.x - side // 2, centre.y - side // 2
    return galsim.BoundsI(low_x, low_x + side - 1, low_y, low_y + side - 1)


def _photons(
    scene: Scene, parts: range, node: int, psf: galsim.GSObject, total: float, random: galsim.BaseDeviate
) -> galsim.PhotonArray | None:
    """Return an object's photons of one node of the band; None where it has none."""
    profiles = []
    for c in parts:
        flux = float(scene.photons[c, node])
        if flux > 0:
            source = component_profile(scene, n=int(scene.owner[c]), c=c)
            profiles.append((psf if source is None else galsim.Convolve(source, psf)) * flux)
    if not profiles:
        return None
    profile = galsim.Sum(profiles)
    share = max(1.0, total / MOST)
    count = galsim.PoissonDeviate(random, mean=profile.flux / share)()
    if not count:
        return None
    photons = profile.makePhot(n_photons=int(count), rng=random, poisson_flux=False)
    photons.flux = np.full(len(photons), share)
    return photons


def _some(photons: galsim.PhotonArray, chosen: np.ndarray) -> galsim.PhotonArray:
    """Return some of the photons."""
    return galsim.PhotonArray(
        int(chosen.sum()),
        x=photons.x[chosen],
        y=photons.y[chosen],
        flux=photons.flux[chosen],
        wavelength=photons.wavelength[chosen],
    )
