"""Oversampled PSF images of exposures: stars of unit flux, with the pixel response."""

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
"""Samples per native pixel, along each axis."""
PSF_IMAGE_PIXELS = 64
"""Side of a PSF image, native pixels."""


def psfs(exposures: Exposures) -> ImageProduct:
    """Return the lazy PSF images of the exposures of an instrument, with the dims (exposure, v, u).

    An image shows a star of flat f_nu at the centre of the detector (Troxel et al. 2023, section 5.2), with 8 samples
    per native pixel; the star is centred on sample 256 of both axes. A sample is the share of the light in a native
    pixel that is centred on the sample: samples that are one native pixel apart sum to 1, apart from the light beyond
    the edge of the image. The coordinates are those of the exposures.
    """
    renderer, images = exposures.renderer, exposures.product
    instrument = renderer.instrument
    side = PSF_IMAGE_PIXELS * OVERSAMPLING

    def unit(row: int) -> Unit:
        return Unit(
            name=exposures.names[row],
            settings={**exposures.units[row].settings, "oversampling": OVERSAMPLING, "side": PSF_IMAGE_PIXELS},
        )

    attributes = {
        "units": "1/pixel",
        "long_name": "unit star, flat f_nu, share of light in a native pixel centred on a sample",
        "oversampling": OVERSAMPLING,
        "pixel_scale": instrument.pixel_scale / OVERSAMPLING,
    }
    return ImageProduct(
        stage=f"psfs/{instrument.name}",
        units=LazyUnits(exposures.names, unit),
        make=MakePsf(renderer),
        variables=(Variable(name="psf", dtype="float32", shape=(side, side), axes=("v", "u"), attributes=attributes),),
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
    """Holds the pointings table and the instrument."""

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return the PSF image of the exposure in a row of the pointings table, by name."""
        exposure, instrument = exposure_of(self.render.table.iloc[index]), self.render.instrument
        ny, nx = instrument.shape
        return {"psf": psf_image(instrument, exposure, (nx - 1) / 2, (ny - 1) / 2)}


def psf_image(
    instrument: Instrument, exposure: Exposure, x: float, y: float, shares: np.ndarray | None = None
) -> np.ndarray:
    """Return the oversampled image of a star of unit flux at a position on the detector.

    Parameters
    ----------
    instrument : Instrument
        Instrument of the exposure.
    exposure : Exposure
        Exposure whose PSF is sampled.
    x, y : float, pixels
        Position on the detector.
    shares : ndarray, shape (nodes,), optional
        Photons of the star's spectrum at each PSF node of the band, in any unit; by default those of a star of flat
        f_nu.

    Returns
    -------
    ndarray, shape (n, n), with n = PSF_IMAGE_PIXELS * OVERSAMPLING
        Image as described in `psfs`.
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
    summary="PSF at the centre of the detector with the pixel response, sampled eight times per native pixel.",
)
