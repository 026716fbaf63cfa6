"""Oversampled PSF images of exposures: stars of unit flux, with the pixel response."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romandask.instruments.exposure import exposure_of
from romandask.instruments.psf_image import OVERSAMPLING, PSF_IMAGE_PIXELS
from romandask.products.images import ImageProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.exposures.exposures import Exposures
from romandask.stages.exposures.render import RenderExposure
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage
from romandask.storage.arrays import Variable


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
    """Holds the pointings table and the PSFs."""

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return the PSF image of the exposure in a row of the pointings table, by name."""
        return {"psf": self.render.psfs.centre(exposure_of(self.render.table.iloc[index]))}


PSF_IMAGES = Stage(
    name="psfs",
    per_survey=True,
    build=lambda context, survey: psfs(context.output(f"exposures/{survey}")),
    units_known_after=UNITS_FROM_POINTINGS,
    on_demand=True,
    unit="visit and detector",
    summary="PSF at the centre of the detector with the pixel response, sampled eight times per native pixel.",
)
