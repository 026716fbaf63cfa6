"""Patches of a coadd that are drawn from a cadence: the expected image, with the mean PSF, and the stack's noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romandask.instruments.exposure import exposure_of
from romandask.instruments.psf_image import flat_shares
from romandask.kernels.coadding.background import subtract_background
from romandask.kernels.coadding.stack import stack
from romandask.kernels.rendering.draw import draw, draw_wide
from romandask.kernels.rendering.fourier import POINT
from romandask.kernels.rendering.psf import PsfModel
from romandask.kernels.rendering.scene import build_scene
from romandask.kernels.rendering.stamps import Scene, plan_stamps
from romandask.model.seeds import realisation_key, rng
from romandask.model.spectra import NJY_ZERO_POINT, Bandpass
from romandask.stages.coadds.input_psfs import psf_side
from romandask.stages.coadds.tile_maker import TileMaker
from romandask.stages.exposures.render import cone
from romandask.stages.pointings import corners_of


@dataclass(frozen=True)
class DrawTile(TileMaker):
    """Makes a patch of a tile in one band from the cadence, without rendering exposures.

    The expected image is drawn once, with the weighted mean PSF of the exposures, and the noise is that of their stack.
    """

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, weight, noise, nimages, dq and psf of a unit."""
        renderer, unit = self.exposures.renderer, self.unit(index)
        instrument = renderer.instrument
        tile, band, wcs, shape = unit.tile, unit.band, unit.wcs, unit.shape
        identity = (instrument.name, tile.id, band, unit.row, unit.column)
        bandpass = instrument.bandpass(band)
        rows = renderer.table.iloc[unit.members]
        exposures = [exposure_of(row) for _, row in rows.iterrows()]
        to_njy = NJY_ZERO_POINT / bandpass.ab_photons()
        gains = np.array([exposure.exptime for exposure in exposures]) / to_njy
        variances = (np.array([instrument.pixel_noise(exposure) for exposure in exposures]) / gains) ** 2
        corners = corners_of(rows)
        polygons = np.stack(wcs.all_world2pix(corners[..., 0].ravel(), corners[..., 1].ravel(), 0, quiet=True), -1)
        layers = stack(polygons.reshape(-1, 4, 2), variances, gains, shape)
        planes = {"weight": layers.weight, "nimages": layers.count, "dq": np.zeros(shape, np.uint8)}
        realisations = self.settings.noise
        if not layers.shares.any():
            side = psf_side(instrument)
            blank = np.zeros((realisations, *shape), np.float32)
            return {**planes, "image": blank[0], "noise": blank, "psf": np.zeros((side, side))}
        truth = renderer.truth.near(*cone(unit.footprint))
        scene = build_scene(truth, wcs, bandpass, to_njy, instrument.knot_smoothing).scene
        faintest = self.render.truncation / np.sqrt(layers.weight.max())
        psf = instrument.effective_psf(exposures, layers.shares)
        stamps = plan_stamps(scene, psf.edges, shape, faintest, self.render.largest)
        covered = layers.weight > 0
        expected = np.where(covered, draw(scene, psf, shape, stamps, faintest), 0)
        empty_variance = np.where(covered, 1 / np.maximum(layers.weight, np.finfo(np.float32).tiny), 0)
        normal = rng(self.seed, "coadds", *identity).standard_normal(shape, dtype=np.float32)
        noise = np.empty((realisations, *shape), np.float32)
        for number, plane in enumerate(noise):
            generator = rng(self.seed, "coadds", "noise", *identity, *realisation_key(number))
            generator.standard_normal(out=plane, dtype=np.float32)
            plane *= np.sqrt(empty_variance)
        image = expected + normal * np.sqrt(empty_variance + layers.source * np.maximum(expected, 0))
        # the background is subtracted as from exposures, because it contains the light of undetected objects
        return {
            **planes,
            "image": np.where(covered, subtract_background(image.astype(np.float32), ~covered), 0),
            "noise": noise,
            "psf": _star(psf, bandpass, psf_side(instrument)),
        }


def _star(psf: PsfModel, bandpass: Bandpass, side: int) -> np.ndarray:
    """Return the image of a star of unit flux and flat f_nu at the centre, shape (side, side)."""
    middle = np.array([(side - 1) / 2])
    scene = Scene(
        x=middle,
        y=middle,
        key=np.zeros(1, np.uint64),
        owner=np.zeros(1, int),
        kind=np.full(1, POINT),
        matrix=np.zeros((1, 2, 2)),
        smoothing=np.zeros((1, 2, 2)),
        knots=np.zeros(1, int),
        photons=flat_shares(bandpass)[None],
    )
    image = np.zeros((side, side), np.float32)
    draw_wide(image, scene, scene.photons, psf.nodes, psf.grid, np.array([psf.grid.size]))
    return image
