"""Exposures: the observed image, the noiseless image and the dq plane of each detector in each visit.

With the full detector model there are also the raw image in data numbers, which is calibrated to give the observed
image, and the variance of the observed image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of, exposures_of
from romandask.instruments.instrument import Instrument
from romandask.instruments.psf_image import flat_shares
from romandask.kernels.coadding.background import mesh_shape
from romandask.kernels.detectors.simple_detector import Detector, usable
from romandask.kernels.rendering.oversampled_image import fine_image
from romandask.model.settings import RenderSettings
from romandask.products.image_set import ImageSet
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.exposures.drawn_area import DrawnArea, drawn_area
from romandask.stages.exposures.render import RenderExposure, cone, stage_of
from romandask.stages.pointings import corners_of
from romandask.stages.psf_models import Psfs, psfs_for, psfs_of
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import truth_of
from romandask.stages.truth.truth_catalogs import TruthCatalogs
from romandask.storage.arrays import Variable
from romandask.storage.store import Store

LAYERS = {
    "background": ("float32", "electron", "expected electrons that do not come from objects"),
    "weight": ("float32", "1/electron2", "inverse variance of an empty pixel; 0 where dq makes the pixel unusable"),
    "psf": ("float32", "1/pixel", "unit star, flat f_nu, at the position of the object, centred on pixel size // 2"),
}
"""Dtype, unit and description of the layers of cutouts that are not stored, by name."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Exposures(ImageSet):
    """The exposures of one instrument: lazy images with the dims (exposure, y, x), and the object that renders them."""

    renderer: RenderExposure
    """Makes the units of the product."""

    @property
    def table(self) -> pd.DataFrame:
        """Pointings table, one row per exposure."""
        return self.renderer.table

    @property
    def instrument(self) -> Instrument:
        """Instrument of the exposures."""
        return self.renderer.instrument

    @property
    def footprints(self) -> np.ndarray:
        """Corners of the exposures, shape (n, 4, 2), degrees."""
        return corners_of(self.table)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of an exposure."""
        return self.instrument.shape

    @property
    def image_bands(self) -> np.ndarray:
        """Band of each exposure, shape (n,)."""
        return self.table["band"].to_numpy(object)

    @property
    def extra_layers(self) -> dict[str, tuple[str, str, str]]:
        """Dtype, unit and description of the layers of cutouts that are not stored, by name."""
        return LAYERS

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of the exposures."""
        return self.names

    def load_image(self, image: int, names: tuple[str, ...], window: tuple[slice, ...] = ()) -> dict[str, np.ndarray]:
        """Return a window of arrays of an exposure, by name."""
        return self.load(image, names, window)

    def with_mesh(self, index: int, names: tuple[str, ...], window: tuple[slice, slice]) -> dict[str, np.ndarray]:
        """Return a window of those arrays of an exposure that there are, and its whole `background_mesh`, by name."""
        image = self.image(index)
        known = [variable.name for variable in self.product.variables if variable.name in names]
        return {**{name: image(name, window) for name in known}, "background_mesh": image("background_mesh")}

    def exposure(self, index: int) -> Exposure:
        """Return one exposure."""
        return exposure_of(self.table.iloc[index])

    def header(self, index: int) -> dict[str, Any]:
        """Return the FITS header of the WCS of an exposure."""
        return self.instrument.header(self.exposure(index))

    def make_layers(
        self,
        index: int,
        wanted: Sequence[str],
        window: tuple[slice, slice],
        arrays: dict[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return the layers `background` and `weight` of a window of an exposure, if they are requested.

        Parameters
        ----------
        index : int
            Index of the exposure.
        wanted : sequence of str
            Names of the requested layers.
        window : (slice, slice)
            Rows and columns of the window.
        arrays : dict of str to ndarray
            Stored arrays of the window. `weight` needs `dq`, and `image` and `variance` if the exposures have a
            variance.
        """
        if not {"background", "weight"} & set(wanted):
            return {}
        background = self.instrument.background(self.exposure(index), self.header(index), *window)
        if "weight" not in wanted:
            return {"background": background}
        variance = empty_variance(arrays, background, self.instrument.detector)
        return {"background": background, "weight": np.where(usable(arrays["dq"]), 1 / variance, np.float32(0))}

    def make_psfs(self, index: int, positions: np.ndarray, size: int) -> np.ndarray:
        """Return images of stars of unit flux and flat f_nu at positions on an exposure.

        Parameters
        ----------
        index : int
            Index of the exposure.
        positions : ndarray, shape (n, 2), pixels
            x and y on the detector.
        size : int, pixels
            Side of an image.

        Returns
        -------
        ndarray, shape (n, size, size), float32
            Each star is centred on pixel size // 2.
        """
        exposure, instrument = self.exposure(index), self.instrument
        psf, shares = self.renderer.psfs.model(exposure), flat_shares(instrument.bandpass(exposure.band))
        return np.stack([fine_image(psf, shares, x, y, size, 1) for x, y in positions]).astype(np.float32)

    def effects(self, index: int) -> dict[str, np.ndarray]:
        """Return the change that each detector effect makes to an exposure.

        Returns
        -------
        dict of str to ndarray, electrons
            One image around the brightest object for each effect, by name; empty if the detector model does not
            separate its effects.
        """
        renderer = self.renderer
        truth = self.load(index, ("truth",))["truth"]
        return self.instrument.effects(renderer.readout, renderer.view(index), truth, renderer.left(index))


def exposures(
    table: pd.DataFrame,
    truth: TruthCatalogs,
    instrument: Instrument,
    render: RenderSettings,
    seed: int,
    calibration: ImageProduct | None = None,
    store: Store | None = None,
    psfs: Psfs | None = None,
    area: DrawnArea | None = None,
) -> Exposures:
    """Return the lazy exposures of a pointings table, with the dims (exposure, y, x).

    Parameters
    ----------
    table : DataFrame
        Pointings table (schema: catalogs/pointings.yaml).
    truth : TruthCatalogs
        Galaxies and stars to draw.
    instrument : Instrument
        Instrument of the exposures.
    render : RenderSettings
        The `render` section of the pipeline.
    seed : int
        Seed of the survey.
    calibration : ImageProduct, optional
        Calibrations of the detectors, for the full detector model; None for the simple one.
    store : Store, optional
        Store that the tables of trapped charge of earlier exposures are read from; None to compute them.
    psfs : Psfs, optional
        PSFs of the exposures (see `psfs_for`); None to compute them.
    area : DrawnArea, optional
        Tiles for which parts of detectors are drawn; None to draw whole detectors, as for a detector model that cannot
        draw a part.
    """
    ny, nx = instrument.shape
    readout = instrument.readout(seed, calibration)
    psfs = psfs_for(instrument, table, calibration) if psfs is None else psfs
    common = {
        "render": render.model_dump(),
        "seed": seed,
        "instrument": instrument.name,
        "n_waves": render.n_waves,
        "knot_smoothing": instrument.knot_smoothing,
        "psf": instrument.psf_settings,
        "readout": readout.settings,
    }
    area = area if readout.draws_parts else None
    all_exposures = exposures_of(table)
    names = [exposure.name for exposure in all_exposures]
    corners = corners_of(table)

    def unit(row: int) -> Unit:
        inputs = truth.inputs(*cone(corners[row]))
        earlier = readout.earlier(table, row).tolist()
        # the charge that an earlier exposure leaves depends only on its own light, and so on the truth near it
        earlier_inputs = [source for k in earlier for source in truth.inputs(*cone(corners[k]))]
        exposure = all_exposures[row]
        return Unit(
            name=names[row],
            settings={
                **common,
                "row": row,
                **vars(exposure),
                "earlier": [vars(all_exposures[k]) for k in earlier],
                "area": None if area is None else area.settings(row),
            },
            inputs=tuple(dict.fromkeys([*inputs, *earlier_inputs, *readout.inputs(exposure), *psfs.inputs(exposure)])),
            prerequisites=tuple(names[k] for k in earlier),
        )

    axes = ("exposure",)

    def coordinates() -> Coordinates:
        columns = ("visit", "detector", "band", "mjd", "exptime", "ra", "dec", "pa")
        headers = [header_text(instrument.header(exposure)) for exposure in all_exposures]
        attributes = {"description": "FITS header of the WCS, 80-column cards"}
        return {
            **{name: (axes, table[name].to_numpy(), {}) for name in columns},
            "exposure": (axes, np.array(names, object), {}),
            "header": (axes, np.array(headers, object), attributes),
        }

    renderer = RenderExposure(
        table=table,
        truth=truth,
        instrument=instrument,
        render=render,
        seed=seed,
        readout=readout,
        psfs=psfs,
        area=area,
        store=store,
    )
    image, *others = readout.variables
    noiseless = Variable(
        name="truth",
        dtype="float32",
        shape=instrument.shape,
        axes=("y", "x"),
        attributes={**image.attributes, "long_name": "noiseless image of the objects"},
        fill=image.fill,
    )
    mesh = Variable(
        name="background_mesh",
        dtype="float32",
        shape=mesh_shape(instrument.shape),
        axes=("mesh_y", "mesh_x"),
        attributes={
            "units": "electron",
            "long_name": "smooth background estimated from the image, as coadds subtract it",
        },
    )
    product = ImageProduct(
        stage=stage_of(instrument),
        units=LazyUnits(tuple(names), unit),
        make=renderer,
        variables=(image, noiseless, *others, mesh),
        axes=axes,
        lengths=(len(table),),
        coordinates=coordinates,
        attributes={"survey": instrument.name, "area": "detector" if area is None else "region"},
        # image, truth, dq, background and working copies; the wide PSF of one node, while it is read or drawn; the
        # objects, and the PSFs of two detectors or bands: the previous ones, and the present ones while they are read
        bytes_per_unit=ny * nx * 28 + 110 * render.largest**2 + (440 << 20),
        # sky, noise, detector effects and storage, then objects; what is not drawn is still stored, as one value
        seconds_per_unit=ny * nx * (readout.seconds_per_pixel + instrument.pixel_scale**2 / 3600 * 0.07)
        if area is None
        else ny * nx * (5e-8 + area.share(instrument.shape, instrument.pixel_scale) * readout.seconds_per_pixel),
        tables=readout.tables,
    )
    return Exposures(product=product, renderer=renderer)


def empty_variance(
    arrays: dict[str, np.ndarray], background: np.ndarray, detector: Detector, window: tuple[slice, ...] = ()
) -> np.ndarray:
    """Return the variance that a window of an exposure would have without objects.

    Parameters
    ----------
    arrays : dict of str to ndarray
        Arrays of the exposure. With the full detector model, `image` and `variance` are used.
    background : ndarray, electrons
        Expected electrons of the window that do not come from objects.
    detector : Detector
        Constants of the detector.
    window : tuple of slice
        Window of the arrays; by default all of them.

    Returns
    -------
    ndarray, float32, electrons^2
        Variance; at least that of the read noise.
    """
    floor = np.float32(detector.read_noise**2)
    if "variance" not in arrays:
        return background + floor
    # the variance contains the Poisson noise of the electrons of the objects
    return np.maximum(arrays["variance"][window] - (arrays["image"][window] - background), floor)


def header_text(header: dict[str, Any]) -> str:
    """Return the cards of a FITS header as text, which keeps every digit of the values."""
    return fits.Header([(key, value) for key, value in header.items()]).tostring(endcard=True)


def wcs_of(text: str) -> WCS:
    """Return the WCS of a FITS header given as text (see `header_text`)."""
    return WCS(fits.Header.fromstring(text))


def build_exposures(context: SurveyContext, survey: str) -> Exposures:
    """Return the lazy exposures of an instrument."""
    pipeline, instrument = context.pipeline, context.instruments[survey]
    calibration = context.output(f"calibration/{survey}") if instrument.calibrated else None
    return exposures(
        context.pointings(survey),
        context.once(truth_of),
        instrument,
        pipeline.render,
        pipeline.seed,
        calibration,
        context.store,
        psfs_of(context, survey),
        _area(context, survey) if pipeline.exposures.area == "region" else None,
    )


def _area(context: SurveyContext, survey: str) -> DrawnArea:
    """Return the area of the exposures of an instrument that the tiles of the survey need."""
    settings, scale = context.pipeline.coadds, context.instruments[survey].coadd_scale
    grid = settings.grid()
    return drawn_area(context.pointings(survey), context.tiles, grid.side, grid.pixels(scale), scale)


def has_exposures(context: SurveyContext, survey: str) -> bool:
    """Return whether the coadds of an instrument are made from exposures, and not drawn directly from its cadence."""
    return context.instruments[survey].coadd != "draw"


EXPOSURES = Stage(
    name="exposures",
    per_survey=True,
    build=build_exposures,
    exists=has_exposures,
    reads=("truth/galaxies", "truth/stars", "calibration", "psf_models"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="visit and detector",
    summary="Observed and noiseless images, rendered in Fourier space with the chromatic PSF at each position and read "
    "out with a simple detector or with all effects of the SCAs or CCDs.",
    shrink_with="lower render.largest",
    tables={"trapped": "exposures/<survey>_trapped/"},
)
