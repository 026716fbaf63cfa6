"""One full-density SCA drawn by the batched renderer and, object by object, by GalSim's photon shooting, on one core.

Prints seconds of the processor, objects a second, the ratio and how well the two agree; run with
`python tests/benchmarks/render.py [BAND]`.
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import galsim
import galsim.roman
import numpy as np
import pandas as pd

from romandask.instruments.exposure import Exposure, footprint
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.rendering.draw import draw
from romandask.kernels.rendering.fourier import POINT
from romandask.kernels.rendering.galsim_engine import object_profile
from romandask.kernels.rendering.stamps import Scene, plan_stamps
from romandask.model.settings import RenderSettings, TruthSettings
from romandask.model.sky import Region
from romandask.stages.exposures.exposures import exposures
from romandask.stages.exposures.render import RenderExposure, View
from romandask.stages.pointings import CORNERS
from romandask.stages.truth.catalogs import truth

BAND = sys.argv[1] if len(sys.argv) > 1 else "H158"
SUBSET = 500
RNG = 20230992


def full_density(roman: Roman) -> RenderExposure:
    """Return an exposure of one SCA over the generator's own catalogs."""
    exposure = Exposure(visit=1, detector=7, band=BAND, mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
    corners = footprint(roman.header(exposure), roman.shape)
    row = vars(exposure) | dict(zip(CORNERS, corners.ravel(), strict=True))
    region = Region(corners[:, 0].min(), corners[:, 0].max(), corners[:, 1].min(), corners[:, 1].max())
    settings = TruthSettings(order=9, nside=256)
    catalogs = truth(settings, Path("."), region, {BAND: roman.bandpass(BAND)}, RNG)
    near = catalogs.near

    class Once:
        """The rows, made once: the generator's time is not the renderer's."""

        def near(self, *cones):
            if not hasattr(self, "rows"):
                self.rows = near(*cones)
            return self.rows

    return replace(exposures(pd.DataFrame([row]), catalogs, roman, RenderSettings(), RNG).renderer, truth=Once())


def seconds(work, repeat: int = 3):
    """Return the least time of some runs and what the work returned."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times), result


def shoot(view: View, chosen: np.ndarray, header: dict) -> float:
    """Draw objects as roman_imsim does and return the seconds: chromatic photon shooting, one object at a time.

    A flux below 40 has a trivial spectrum (one achromatic PSF), below 10 also a stamp of 32 pixels.
    """
    scene = view.drawable.scene
    bandpass = galsim.roman.getBandpasses(AB_zeropoint=True)[BAND]
    wcs = galsim.FitsWCS(header=galsim.FitsHeader(header))
    psf = galsim.roman.getPSF(view.exposure.detector, BAND, pupil_bin=8, n_waves=5)
    achromatic = galsim.roman.getPSF(view.exposure.detector, BAND, pupil_bin=8, wavelength=bandpass)
    trivial = galsim.SED(galsim.LookupTable([100, 2600], [1, 1], interpolant="linear"), "nm", "fphotons")
    spectrum = galsim.SED("CWW_Sbc_ext.sed", "Ang", "flambda")
    image = galsim.ImageF(4088, 4088)
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    flux = scene.fluxes()
    noise = galsim.BaseDeviate(RNG)
    start = time.process_time()
    for n in chosen:
        place = galsim.PositionD(scene.x[n] + 1, scene.y[n] + 1)
        profile = object_profile(scene, n, first, [galsim.Gaussian(sigma=1e-3)] * scene.photons.shape[1])
        local = wcs.local(place)
        # the same shapes, in the sky's frame, as that loop has them
        profile = local.toWorld(profile).withFlux(flux[n])
        if flux[n] < 40:
            one = galsim.Convolve(profile * trivial.withFlux(1.0, bandpass), achromatic)
        else:
            one = galsim.Convolve(profile * spectrum.withFlux(1.0, bandpass), psf)
        size = 32 if flux[n] < 10 else good_size(one, bandpass)
        x0, y0 = int(place.x) - size // 2, int(place.y) - size // 2
        stamp = galsim.ImageF(galsim.BoundsI(x0, x0 + size - 1, y0, y0 + size - 1))
        one.drawImage(bandpass, image=stamp, wcs=local, center=place, method="phot", rng=noise, poisson_flux=True)
        part = stamp.bounds & image.bounds
        if part.isDefined():
            image[part] += stamp[part]
    return time.process_time() - start


def good_size(profile: galsim.ChromaticObject, bandpass: galsim.Bandpass) -> int:
    """Return the stamp that GalSim would choose."""
    return profile.evaluateAtWavelength(bandpass.effective_wavelength).getGoodImageSize(galsim.roman.pixel_scale)


def with_bright_stars(scene: Scene, zero: float) -> Scene:
    """Return a scene with four stars of magnitude 14 and one of 11.5, as a detector has them on average."""
    magnitudes = np.array([14.0, 14.0, 14.0, 14.0, 11.5])
    n, places = len(scene.x), np.random.default_rng(RNG).uniform(0, 4088, (5, 2))
    photons = np.repeat(zero * 10 ** (-0.4 * magnitudes)[:, None] / 5, 5, axis=1)
    blank = np.zeros((5, 2, 2))
    return Scene(
        np.r_[scene.x, places[:, 0]],
        np.r_[scene.y, places[:, 1]],
        np.r_[scene.key, np.zeros(5, np.uint64)],
        np.r_[scene.owner, n + np.arange(5)],
        np.r_[scene.kind, np.full(5, POINT)],
        np.r_[scene.matrix, blank],
        np.r_[scene.smoothing, blank],
        np.r_[scene.knots, np.zeros(5, int)],
        np.r_[scene.photons, photons],
    )


def main() -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore")
    roman = Roman(RomanSettings(bands=(BAND,)))
    source = full_density(roman)
    view = source.view(0)
    view.expected()  # compiles
    scene_time, view = seconds(lambda: source.view(0))
    psf = roman.psf(view.exposure)
    # of the same SCA and band again: the PSF is made once
    sampling = time.process_time()
    Roman(RomanSettings(bands=(BAND,), charge_diffusion=1e-6)).psf(view.exposure)
    sampling = time.process_time() - sampling
    plain = replace(view.stamps, bright=np.full(len(view.stamps.size), -1))
    scene = view.drawable.scene
    drawing, _ = seconds(lambda: draw(scene, psf, roman.shape, plain, view.faintest))
    psfs = roman.bright_psfs(view.exposure)
    more = with_bright_stars(scene, roman.bandpass(BAND).ab_photons() * view.exposure.exptime)
    stamps = plan_stamps(more, psf.edges, roman.shape, view.faintest, 2048, psfs)
    first_time, _ = seconds(lambda: draw(more, psf, roman.shape, stamps, view.faintest, psfs), 1)
    held = tuple(replace(one, nodes=list(one.nodes)) for one in psfs)
    bright_time, _ = seconds(lambda: draw(more, psf, roman.shape, stamps, view.faintest, held), 2)
    drawn = np.flatnonzero(view.stamps.size)
    faint = np.flatnonzero((view.stamps.size > 0) & (view.stamps.bright < 0))
    mix = np.bincount(np.log2(view.stamps.size[drawn]).astype(int))
    print(f"objects drawn {len(drawn)}")
    print("stamps       " + ", ".join(f"{2**k}: {n}" for k, n in enumerate(mix) if n))
    print(f"scene        {scene_time:8.2f} s  positions, spectra, stamps, sky")
    print(f"PSF          {sampling:8.2f} s  once an SCA and band")
    print(f"objects      {drawing:8.2f} s  {len(drawn) / drawing:9.0f} objects/s")
    print(f"bright stars {bright_time - drawing:8.2f} s  four of magnitude 14 and one of 11.5 added")
    print(f"their PSFs   {first_time - bright_time:8.2f} s  once an SCA and band")
    chosen = np.random.default_rng(RNG).choice(faint, SUBSET, replace=False)
    taken = shoot(view, chosen, view.header)
    whole = taken / SUBSET * len(drawn)
    print(f"GalSim       {whole:8.2f} s  {SUBSET / taken:9.0f} objects/s  from {SUBSET} objects, photon shooting")
    print(f"ratio        {whole / drawing:8.0f}   drawing alone")
    print(f"ratio        {whole / (scene_time + drawing):8.0f}   with the scene")
    print(f"ratio        {whole / (scene_time + bright_time):8.0f}   with the scene and the bright stars")
    print(f"ratio        {whole / (scene_time + sampling + first_time):8.0f}   with all, every PSF made afresh")
    accuracy(source, view)


def accuracy(source: RenderExposure, view: View) -> None:
    """Print how a part of the same scene agrees with GalSim drawing it by FFT with the exact PSF of that place."""
    x0, y0, side = 2044 - 128, 2044 - 128, 256
    scene, roman = view.drawable.scene, source.instrument
    near = (np.abs(scene.x - 2044) < side / 2 + 8) & (np.abs(scene.y - 2044) < side / 2 + 8)
    near &= view.stamps.size > 0
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    noise = np.sqrt(view.background.mean() + roman.detector.read_noise**2)
    only = replace(view.stamps.only(near), bright=np.full(len(near), -1))
    ours = draw(scene, roman.psf(view.exposure), roman.shape, only, view.faintest)
    total = galsim.ImageD(galsim.BoundsI(x0, x0 + side - 1, y0, y0 + side - 1), scale=1.0)
    for n in np.flatnonzero(near):
        profiles = [one.dilate(1 / roman.pixel_scale) for one in roman.profiles(view.exposure, scene.x[n], scene.y[n])]
        profile = object_profile(scene, n, first, profiles)
        stamp = total.copy()
        centre = galsim.PositionD(scene.x[n], scene.y[n])
        profile.drawImage(stamp, center=centre)
        total += stamp
    residual = ours[y0 : y0 + side, x0 : x0 + side] - total.array
    share = np.abs(residual) / noise
    flux = ours[y0 : y0 + side, x0 : x0 + side].sum() / total.array.sum() - 1
    print(f"agreement with GalSim FFT, {near.sum()} objects on {side} x {side} pixels: total flux {flux:+.1e}")
    print(f"  residual over sky noise: rms {residual.std() / noise:.1e}, 99.9% below {np.quantile(share, 0.999):.1e}")
    print(f"  largest {share.max():.1e}")


if __name__ == "__main__":
    main()
