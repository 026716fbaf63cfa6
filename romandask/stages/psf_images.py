"""PSF images: for each exposure a unit star, sampled eight times finer than its pixels, pixel response included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romandask.instruments.exposure import Exposure, exposure_of
from romandask.instruments.instrument import Instrument
from romandask.kernels.rendering.oversampled_image import fine_image
from romandask.products.images import ImageProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.exposures.exposures import Exposures, flat_shares
from romandask.stages.exposures.render import RenderExposure
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage
from romandask.storage.arrays import Variable

OVERSAMPLING = 8
"""Samples along a pixel."""
PSF_IMAGE_PIXELS = 64
"""Native pixels that an image covers."""


def psfs(exposures: Exposures) -> ImageProduct:
    """Return the lazy PSF images of a survey's exposures: dims (exposure, v, u), coordinates those of the exposures.

    Each is the PSF in the middle of the detector of a star of flat f_nu (Troxel et al. 2023, section 5.2), 8 samples a
    pixel, its centre on sample 256 of both axes. A sample is the share of the star's light in a native pixel
    centred there: every eighth sample sums to one but for the light beyond the edge.
    """
    renderer, images, every = exposures.renderer, exposures.product, exposures.units
    instrument = renderer.instrument
    side = PSF_IMAGE_PIXELS * OVERSAMPLING

    def unit(row: int) -> Unit:
        return Unit(
            exposures.names[row], {**every[row].settings, "oversampling": OVERSAMPLING, "side": PSF_IMAGE_PIXELS}
        )

    text = {
        "units": "1/pixel",
        "long_name": "unit star, flat f_nu, share of light in a native pixel centred on a sample",
        "oversampling": OVERSAMPLING,
        "pixel_scale": instrument.pixel_scale / OVERSAMPLING,
    }
    return ImageProduct(
        stage=f"psfs/{instrument.name}",
        units=LazyUnits(exposures.names, unit),
        make=MakePsf(renderer),
        variables=(Variable("psf", "float32", (side, side), ("v", "u"), text),),
        axes=images.axes,
        lengths=images.lengths,
        coordinates=images.coordinates,
        attributes={"survey": instrument.name},
        bytes_per_unit=350 << 20,
        seconds_per_unit=0.7,
    )


@dataclass(frozen=True)
class MakePsf:
    """Makes the PSF image of one exposure."""

    render: RenderExposure

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return the image of the exposure at a row of the pointings table."""
        exposure, instrument = exposure_of(self.render.table.iloc[index]), self.render.instrument
        ny, nx = instrument.shape
        return {"psf": psf_image(instrument, exposure, (nx - 1) / 2, (ny - 1) / 2)}


def psf_image(
    instrument: Instrument, exposure: Exposure, x: float, y: float, shares: np.ndarray | None = None
) -> np.ndarray:
    """Return the PSF image (side, side) at a place, pixels.

    Parameters
    ----------
    shares : (nodes,) photons of the star's spectrum by node of the band; those of flat f_nu where none are given
    """
    bandpass = instrument.bandpass(exposure.band)
    shares = flat_shares(bandpass) if shares is None else np.asarray(shares, float) / np.sum(shares)
    return fine_image(instrument.psf_at(exposure, x, y), shares, x, y, PSF_IMAGE_PIXELS, OVERSAMPLING)


PSF_IMAGES = Stage(
    name="psfs",
    per_survey=True,
    build=lambda context, survey: psfs(context.output(f"exposures/{survey}")),
    units_known_after=UNITS_FROM_POINTINGS,
    on_demand=True,
    unit="visit and detector",
    summary="A unit star at the middle of the detector, sampled eight times finer than its pixels.",
)
