"""Noise of coadds: measured once a tile, so that all patches of the tile detect objects alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romandask.kernels.measurement.measurement_image import NOISE_RADII
from romandask.kernels.measurement.noise import Noise
from romandask.products.image_set import ImageSet
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.coadds.input_psfs import psf_side
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.detections.field import FieldNoise
from romandask.stages.detections.tile_field import field_of, tile_field, units_in
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.storage.arrays import Variable

SAMPLES, SAMPLE_SIDE = 4, 512
"""Number of rows, and of columns, of the windows in which the noise of a large tile is measured, and their side,
pixels: four million pixels in all."""
DETECTION = "detection"
"""Name of the detection image on the axis `plane`, after those of the bands."""


@dataclass(frozen=True, kw_only=True, repr=False)
class CoaddNoise(ImageSet):
    """Noise of the tiles of an instrument."""

    bands: tuple[str, ...]
    """Bands whose noise is measured."""

    def noise(self, tile: int) -> FieldNoise:
        """Return the noise of the tile with an index."""
        arrays = self.load(tile)
        planes = [
            Noise(rms=float(rms), aperture_ratios=ratios, psf_ratio=float(psf_ratio))
            for rms, ratios, psf_ratio in zip(arrays["rms"], arrays["aperture_ratio"], arrays["psf_ratio"], strict=True)
        ]
        return FieldNoise(
            bands=dict(zip(self.bands, planes[:-1], strict=True)),
            weights=dict(zip(self.bands, arrays["weight"].tolist(), strict=True)),
            detection=planes[-1],
            psf=arrays["psf"],
        )


def coadd_noise(coadds: Coadds) -> CoaddNoise:
    """Return the lazy noise of a survey's coadds, one unit per tile.

    Returns
    -------
    CoaddNoise
        Arrays of each tile, for each plane (a band, or the detection image): `rms`, that of a pixel of unit weight;
        `aperture_ratio` and `psf_ratio`, the scatter of fluxes in the noise over that in white noise. `weight` is the
        median weight of each band, and `psf` the PSF of the detection image.
    """
    instrument, tiles = coadds.instrument, coadds.tiles
    bands = tuple(dict.fromkeys((*instrument.bands, *(instrument.detection_bands or ()))))
    planes, side = len(bands) + 1, psf_side(instrument)
    settings = {"bands": bands, "detection": [instrument.detection, instrument.detection_bands]}

    def unit(index: int) -> Unit:
        name = tiles[index].name
        return Unit(name, {**settings, "tile": name}, units_in(coadds, index, sample_windows(coadds.pixels)))

    def coordinates() -> Coordinates:
        of_tiles = {key: value for key, value in coadds.product.coordinates().items() if value[0] == ("tile",)}
        return of_tiles | {
            "plane": (("plane",), np.array([*bands, DETECTION], object), {}),
            "radius": (("radius",), NOISE_RADII, {"units": "pix"}),
        }

    def of_planes(name: str, text: str, *axes: str) -> Variable:
        lengths = {"plane": planes, "band": len(bands), "radius": len(NOISE_RADII)}
        return Variable(name, "float64", tuple(lengths[axis] for axis in axes), axes, {"long_name": text})

    product = ImageProduct(
        stage=f"coadd_noise/{instrument.name}",
        units=LazyUnits(tuple(tile.name for tile in tiles), unit),
        make=MeasureNoise(coadds, bands),
        variables=(
            of_planes("rms", "rms of a pixel of unit weight", "plane"),
            of_planes("aperture_ratio", "scatter of aperture fluxes over that in white noise", "plane", "radius"),
            of_planes("psf_ratio", "scatter of PSF fluxes over that in white noise", "plane"),
            of_planes("weight", "median weight of a band", "band"),
            Variable("psf", "float64", (side, side), ("v", "u"), {"long_name": "PSF of the detection image"}),
        ),
        axes=("tile",),
        lengths=(len(tiles),),
        coordinates=coordinates,
        attributes={"survey": instrument.name, "pixel_scale": instrument.coadd_scale},
        # windows of the noise and the weight of a band, and the chunks that they are read from
        bytes_per_unit=280 << 20,
        seconds_per_unit=0.2 + min(coadds.pixels, SAMPLES * SAMPLE_SIDE) ** 2 * 2.5e-7 * planes,
    )
    return CoaddNoise(product=product, bands=bands)


def sample_windows(pixels: int) -> list[tuple[slice, slice]]:
    """Return the windows, of one size, of a tile with `pixels` pixels a side in which its noise is measured.

    They are spread over a large tile, each around a quarter of its cell, so that it lies in one chunk of a patch of
    that size; a small tile is one window.
    """
    if pixels <= SAMPLES * SAMPLE_SIDE:
        return [(slice(0, pixels), slice(0, pixels))]
    cell = pixels / SAMPLES
    inset = max(int(cell / 4) - SAMPLE_SIDE // 2, 0)
    starts = [int(k * cell) + inset for k in range(SAMPLES)]
    parts = [slice(start, start + SAMPLE_SIDE) for start in starts]
    return [(rows, columns) for rows in parts for columns in parts]


@dataclass(frozen=True)
class MeasureNoise:
    """Measures the noise of one tile."""

    coadds: Coadds
    bands: tuple[str, ...]

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return the arrays of a tile (see `coadd_noise`)."""
        windows = sample_windows(self.coadds.pixels)
        grid = self.coadds.patches
        touched = sorted({patch for window in windows for patch in grid.touching(window)})
        field = field_of(self.coadds, index, tile_field(self.coadds, index).window, tuple(touched))
        noise = field.noise(windows)
        planes = [*(noise.bands[band] for band in self.bands), noise.detection]
        return {
            "rms": np.array([plane.rms for plane in planes]),
            "aperture_ratio": np.stack([plane.aperture_ratios for plane in planes]),
            "psf_ratio": np.array([plane.psf_ratio for plane in planes]),
            "weight": np.array([noise.weights[band] for band in self.bands]),
            "psf": noise.psf,
        }


def build_coadd_noise(context: SurveyContext, survey: str) -> CoaddNoise:
    """Return the lazy noise of a survey's coadds (the `build` of the stage)."""
    return coadd_noise(context.output(f"coadds/{survey}"))


COADD_NOISE = Stage(
    name="coadd_noise",
    per_survey=True,
    build=build_coadd_noise,
    reads=("coadds",),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="tile",
    summary="The rms of the noise of a tile and how far it is correlated, in each band and in the detection image, by "
    "which all patches of the tile detect and measure alike.",
)
