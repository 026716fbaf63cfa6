"""Exposures: for each detector of each visit the observed image, the noiseless true image and the dq plane.

With the full model of a detector also the raw data numbers, of which the image is the calibration, and its variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of, exposures_of
from romandask.instruments.instrument import Instrument
from romandask.kernels.detectors.simple_detector import Detector, usable
from romandask.kernels.rendering.oversampled_image import fine_image
from romandask.model.settings import RenderSettings
from romandask.model.spectra import Bandpass, ab_photon_density
from romandask.products.image_set import ImageSet
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.units import LazyUnits, Unit
from romandask.stages.exposures.render import RenderExposure, cone, stage_of
from romandask.stages.pointings import corners_of
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import TruthCatalogs, truth_of
from romandask.storage.arrays import Variable
from romandask.storage.store import Store

LAYERS = {
    "background": ("float32", "electron", "expected electrons that do not come from objects"),
    "weight": ("float32", "1/electron2", "inverse variance of an empty pixel; 0 where dq forbids it"),
    "psf": ("float32", "1/pixel", "unit star, flat f_nu, at the object's place, centred on pixel size // 2"),
}
"""Layers that cutouts of exposures have beside the stored arrays: dtype, unit, description."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Exposures(ImageSet):
    """The exposures of one instrument: lazy images (exposure, y, x), and what makes them."""

    renderer: RenderExposure

    @property
    def table(self) -> pd.DataFrame:
        """The pointings, one row an exposure."""
        return self.renderer.table

    @property
    def instrument(self) -> Instrument:
        """The instrument."""
        return self.renderer.instrument

    @property
    def footprints(self) -> np.ndarray:
        """(n, 4, 2) corners of the exposures, degrees."""
        return corners_of(self.table)

    @property
    def image_shape(self) -> tuple[int, int]:
        """(ny, nx) of an exposure."""
        return self.instrument.shape

    @property
    def unit_bands(self) -> np.ndarray:
        """(n,) band of each exposure."""
        return self.table["band"].to_numpy(object)

    @property
    def extra_layers(self) -> dict[str, tuple[str, str, str]]:
        """Layers of cutouts beside the stored arrays: dtype, unit, description."""
        return LAYERS

    def exposure(self, index: int) -> Exposure:
        """Return one exposure."""
        return exposure_of(self.table.iloc[index])

    def header(self, index: int) -> dict:
        """Return the FITS header of the WCS of an exposure."""
        return self.instrument.header(self.exposure(index))

    def make_layers(
        self,
        index: int,
        wanted: Sequence[str],
        window: tuple[slice, slice],
        arrays: dict[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return the layers `background` and `weight` of a window of an exposure, where they are wanted.

        Parameters
        ----------
        index : int
            Of the exposure.
        wanted : sequence of str
        window : (slice, slice)
            Rows and columns.
        arrays : dict of str to ndarray
            Stored arrays of the window; `weight` needs `dq`, and `image` and `variance` where there is a variance.
        """
        if not {"background", "weight"} & set(wanted):
            return {}
        background = self.instrument.background(self.exposure(index), self.header(index), *window)
        if "weight" not in wanted:
            return {"background": background}
        variance = empty_variance(arrays, background, self.instrument.detector)
        return {"background": background, "weight": np.where(usable(arrays["dq"]), 1 / variance, np.float32(0))}

    def make_psfs(self, index: int, positions: np.ndarray, size: int) -> np.ndarray:
        """Return the PSF (n, size, size) of a star of flat f_nu at positions (n, 2), pixels, of an exposure."""
        exposure, instrument = self.exposure(index), self.instrument
        psf, shares = instrument.psf(exposure), flat_shares(instrument.bandpass(exposure.band))
        return np.stack([fine_image(psf, shares, x, y, size, 1) for x, y in positions]).astype(np.float32)

    def effects(self, index: int) -> dict[str, np.ndarray]:
        """Return what each effect of the detector does to an exposure: images around its brightest object, electrons.

        Empty where the detector has no effects that can be taken apart.
        """
        renderer = self.renderer
        truth = self.load(index, ("truth",))["truth"]
        return self.instrument.effects(renderer.readout, renderer.view(index), truth, renderer.left(index))


def flat_shares(bandpass: Bandpass) -> np.ndarray:
    """Return the share of the photons of a source of flat f_nu that goes to each PSF node of a band."""
    photons = (ab_photon_density(bandpass.wave) * bandpass.weights) @ bandpass.node_weights()
    return photons / photons.sum()


def exposures(
    table: pd.DataFrame,
    truth: TruthCatalogs,
    instrument: Instrument,
    render: RenderSettings,
    seed: int,
    calibration: ImageProduct | None = None,
    store: Store | None = None,
) -> Exposures:
    """Return the lazy exposures of a pointings table: dims (exposure, y, x).

    Parameters
    ----------
    table : DataFrame
        Pointings (schema: catalogs/pointings.yaml).
    truth : TruthCatalogs
    instrument : Instrument
    render : RenderSettings
    seed : int
        Of the survey.
    calibration : ImageProduct or None
        Of the detectors, for the full model of a detector; None for the simple one.
    store : Store or None
        Where the tables that earlier exposures left may be; None to work them out.
    """
    ny, nx = instrument.shape
    readout = instrument.readout(seed, calibration)
    common = {
        "render": render.model_dump(),
        "seed": seed,
        "instrument": instrument.name,
        "n_waves": render.n_waves,
        "knot_smoothing": instrument.knot_smoothing,
        "psf": instrument.psf_settings,
        "readout": readout.settings,
    }
    every = exposures_of(table)
    names = [exposure.name for exposure in every]
    corners = corners_of(table)

    def unit(row: int) -> Unit:
        inputs = truth.inputs(*cone(corners[row]))
        earlier = readout.earlier(table, row).tolist()
        # what an exposure leaves depends on its own light alone, so on the truth around it
        lights = [source for k in earlier for source in truth.inputs(*cone(corners[k]))]
        return Unit(
            name=names[row],
            settings={**common, "row": row, **vars(every[row]), "earlier": [vars(every[k]) for k in earlier]},
            inputs=tuple(dict.fromkeys([*inputs, *lights, *readout.inputs(every[row])])),
            prerequisites=tuple(names[k] for k in earlier),
            # PSFs are those of a detector and band
            affinity=f"{every[row].band}-{every[row].detector}",
        )

    axes = ("exposure",)

    def coordinates() -> Coordinates:
        columns = ("visit", "detector", "band", "mjd", "exptime", "ra", "dec", "pa")
        headers = [header_text(instrument.header(exposure)) for exposure in every]
        text = {"description": "FITS header of the WCS, 80-column cards"}
        return {
            **{name: (axes, table[name].to_numpy(), {}) for name in columns},
            "exposure": (axes, np.array(names, object), {}),
            "header": (axes, np.array(headers, object), text),
        }

    renderer = RenderExposure(
        table=table, truth=truth, instrument=instrument, render=render, seed=seed, readout=readout, store=store
    )
    image, *others = readout.variables
    noiseless = {"units": "electron", "long_name": "noiseless image of the objects"}
    product = ImageProduct(
        stage=stage_of(instrument),
        units=LazyUnits(tuple(names), unit),
        make=renderer,
        variables=(image, Variable("truth", "float32", instrument.shape, ("y", "x"), noiseless), *others),
        axes=axes,
        lengths=(len(table),),
        coordinates=coordinates,
        attributes={"survey": instrument.name},
        # image, truth, dq, background and working copies; the wide PSF of one node, as it is sampled or as it is
        # drawn; the objects, and the PSFs of a detector and band, the last and the new
        bytes_per_unit=ny * nx * 28 + 110 * render.largest**2 + (440 << 20),
        # sky, noise and storage, every effect and its calibration; then objects
        seconds_per_unit=ny * nx * (readout.seconds_per_pixel + instrument.pixel_scale**2 / 3600 * 0.15),
        tables=readout.tables,
    )
    return Exposures(product=product, renderer=renderer)


def empty_variance(
    arrays: dict[str, np.ndarray], background: np.ndarray, detector: Detector, window: tuple[slice, ...] = ()
) -> np.ndarray:
    """Return the variance (float32, electrons^2) that a window of an exposure would have without objects.

    Parameters
    ----------
    arrays : whole arrays of the exposure; of the full model of a detector `image` and `variance` are used
    background : expected electrons of the window
    """
    floor = np.float32(detector.read_noise**2)
    if "variance" not in arrays:
        return background + floor
    # the image's own electrons are in its variance
    return np.maximum(arrays["variance"][window] - (arrays["image"][window] - background), floor)


def header_text(header: dict) -> str:
    """Return the cards of a header as one text, exact to the last digit of every value."""
    return fits.Header([(key, value) for key, value in header.items()]).tostring(endcard=True)


def wcs_of(text: str) -> WCS:
    """Return the WCS of a header text."""
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
    )


def has_exposures(context: SurveyContext, survey: str) -> bool:
    """Return whether an instrument's coadds are made from exposures, not drawn from its cadence."""
    return context.instruments[survey].coadd != "draw"


EXPOSURES = Stage(
    name="exposures",
    per_survey=True,
    build=build_exposures,
    exists=has_exposures,
    reads=("truth/galaxies", "truth/stars", "calibration"),
    units_known_after=UNITS_FROM_POINTINGS,
    unit="visit and detector",
    summary="Images rendered in Fourier space with the chromatic PSF of each place on the detector: the noiseless "
    "image of the objects beside the observed one; a simple detector, or every effect of the SCAs or CCDs.",
    shrink_with="lower render.largest",
    tables={"trapped": "exposures/<survey>_trapped/"},
)
