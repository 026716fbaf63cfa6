"""Exposures: for each detector of each visit the observed image, the noiseless true one and the dq plane.

With the full model of the SCAs also what was read (raw), of which the image is the calibration, and its variance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import galsim
import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.wcs import WCS

from romandask.instruments.instrument import Exposure, Instrument, exposure_of, exposures_of
from romandask.instruments.roman.roman import Roman
from romandask.instruments.roman.sca_readout import ScaReadout, before, trapped_table
from romandask.instruments.rubin.ccd_readout import CcdReadout
from romandask.instruments.rubin.rubin import Rubin
from romandask.kernels.detectors.sca_exposure import FLAGS
from romandask.kernels.detectors.simple_detector import DQ_FLAGS, Detector, observe
from romandask.kernels.rendering.draw import Stamps, draw, plan_stamps
from romandask.kernels.rendering.galsim_engine import draw_objects
from romandask.kernels.rendering.scene import Drawable, Truth, build_scene
from romandask.kernels.rendering.silicon import LEAST, through_silicon
from romandask.model.seeds import rng
from romandask.model.settings import RenderSettings
from romandask.model.sky import radec, unit_vectors
from romandask.products.images import Coordinates, ImageProduct, table_beside
from romandask.products.schemas import schema
from romandask.products.tables import to_frame
from romandask.products.units import LazyUnits, Unit
from romandask.stages.pointings import corners_of
from romandask.stages.truth.catalogs import TruthCatalogs
from romandask.storage.arrays import Variable
from romandask.storage.manifest import read_record
from romandask.storage.store import Store, read_parquet

REACH = 30.0
"""Objects this far outside a detector, arcsec, may shine on it."""
STAR_REACH = 115.0
"""So may bright stars, for their diffraction spikes are long."""


@dataclass(frozen=True)
class View:
    """What an exposure looks at, ready to be drawn."""

    exposure: Exposure
    header: dict
    truth: Truth
    drawable: Drawable
    background: np.ndarray
    """(ny, nx) expected electrons that do not come from objects."""
    faintest: float
    """Surface brightness, electrons a pixel, below which stamps may end."""
    stamps: Stamps
    """Of the drawable objects."""


@dataclass(frozen=True)
class RenderExposure:
    """Makes the arrays of one exposure."""

    table: pd.DataFrame
    truth: TruthCatalogs
    instrument: Instrument
    render: RenderSettings
    seed: int
    readout: ScaReadout | CcdReadout | None = None
    """None for the simple detector."""
    store: Store | None = None
    """Where what exposures left in traps may lie."""

    def view(self, index: int) -> View:
        """Return what the exposure at a row of the pointings table looks at."""
        exposure, instrument = exposure_of(self.table.iloc[index]), self.instrument
        header = instrument.header(exposure)
        truth = self.truth.near(*cone(corners_of(self.table.iloc[[index]])[0]))
        drawable = build_scene(
            truth,
            WCS(header),
            instrument.bandpass(exposure.band),
            exposure.exptime,
            instrument.knot_smoothing,
            (instrument.shape, STAR_REACH / instrument.pixel_scale),
        )
        background = instrument.background(exposure, header)
        faintest = self.render.truncation * instrument.sky_noise(exposure, background)
        stamps = plan_stamps(
            drawable.scene,
            instrument.psf_edges(exposure),
            instrument.shape,
            faintest,
            self.render.largest,
            instrument.bright_psfs(exposure),
        )
        return View(exposure, header, truth, drawable, background, faintest, stamps)

    def expected(self, view: View) -> np.ndarray:
        """Return the noiseless image (ny, nx), electrons, of the objects."""
        instrument, exposure = self.instrument, view.exposure
        if self.render.engine == "galsim":
            scale = instrument.pixel_scale
            profiles = Profiles(instrument, exposure)
            return draw_objects(view.drawable.scene, profiles, instrument.shape, view.stamps, scale)
        psf, bright = instrument.psf(exposure), instrument.bright_psfs(exposure)
        return draw(view.drawable.scene, psf, instrument.shape, view.stamps, view.faintest, bright)

    def __call__(self, index: int) -> dict[str, Any]:
        """Return the arrays of the exposure at a row of the pointings table, by name, and its table of traps."""
        view = self.view(index)
        if isinstance(self.readout, CcdReadout):
            return self.through_ccd(view, self.readout)
        expected = self.expected(view)
        if self.readout is not None:
            light = expected + view.background
            return {**self.readout(view.exposure, light, self.left(index)), "truth": expected}
        random = rng(self.seed, "exposures", self.instrument.name, view.exposure.visit, view.exposure.detector)
        image, dq = observe(expected, view.background, self.instrument.detector, random)
        return {"image": image, "truth": expected, "dq": dq}

    def through_ccd(self, view: View, readout: CcdReadout) -> dict[str, Any]:
        """Return the arrays of an exposure of a CCD, its bright objects photon by photon where that is asked for."""
        exposure, instrument, scene = view.exposure, readout.instrument, view.drawable.scene
        bright = (scene.fluxes() >= LEAST) & (view.stamps.size > 0)
        if instrument.settings.sensor == "ideal" or not bright.any():
            expected = self.expected(view)
            return {**readout(exposure, expected, view.background, None), "truth": expected}
        chosen = np.flatnonzero(bright)
        faint, shining = (
            self.expected(replace(view, stamps=replace(view.stamps, size=np.where(part, view.stamps.size, 0))))
            for part in (~bright, bright)
        )

        def seed(n: int) -> int:
            return int(readout.random(exposure, "photons", int(scene.key[n])).integers(1, 1 << 31))

        caught = through_silicon(
            scene,
            chosen,
            view.stamps.size,
            Profiles(instrument, exposure),
            instrument.bandpass(exposure.band).nodes,
            instrument.shape,
            instrument.pixel_scale,
            seed,
        )
        return {**readout(exposure, faint, view.background, caught), "truth": faint + shining}

    def left(self, index: int) -> list[tuple[Exposure, pd.DataFrame]]:
        """Return the exposures before one whose afterglow it has, each with what it left in traps."""
        return [(exposure_of(self.table.iloc[row]), self.trapped(row)) for row in before(self.table, index).tolist()]

    def trapped(self, index: int) -> pd.DataFrame:
        """Return what an exposure left in traps: read where it is stored, worked out where not."""
        assert isinstance(self.readout, ScaReadout)
        exposure, stage = exposure_of(self.table.iloc[index]), stage_of(self.instrument)
        if self.store is not None and read_record(self.store, stage, exposure.name):
            return to_frame(read_parquet(table_beside(self.store, stage, "trapped", exposure.name)))
        view = self.view(index)
        planes = self.readout.planes(exposure)
        light, response = self.expected(view) + view.background, self.readout.response(exposure, planes)
        return trapped_table(self.readout.charge(exposure, light, planes, response)[0], planes)


@dataclass(frozen=True, eq=False)
class Profiles:
    """GalSim's PSFs of an exposure, one a node, on a coarse grid of places: what the second engine draws with."""

    instrument: Instrument
    exposure: Exposure
    cells: int = 4
    """Along each side of the detector; an object has the PSF of the middle of its cell."""

    def __call__(self, x: float, y: float) -> tuple[tuple[int, int], list[galsim.GSObject]]:
        """Return the cell of a position and the PSFs there."""
        i, j = (
            int(np.clip(value * self.cells // side, 0, self.cells - 1))
            for value, side in zip((x, y), self.instrument.shape[::-1], strict=True)
        )
        return (i, j), _cell_profiles(self, i, j)


@lru_cache(maxsize=2)
def _cell_profiles(profiles: Profiles, i: int, j: int) -> list[galsim.GSObject]:
    ny, nx = profiles.instrument.shape
    x, y = (i + 0.5) * nx / profiles.cells - 0.5, (j + 0.5) * ny / profiles.cells - 0.5
    return profiles.instrument.profiles(profiles.exposure, x, y)


def stage_of(instrument: Instrument) -> str:
    """Return the name of the stage of an instrument's exposures."""
    return f"exposures/{instrument.name}"


def exposures(
    table: pd.DataFrame,
    truth: TruthCatalogs,
    instrument: Instrument,
    render: RenderSettings,
    seed: int,
    calibration: ImageProduct | None = None,
    store: Store | None = None,
) -> ImageProduct:
    """Return the lazy exposures of a pointings table: dims (exposure, y, x).

    Parameters
    ----------
    calibration : of Roman's SCAs, for the full model of the detector; None for the simple one
    store : where what exposures left in traps may lie; None to work it out when it is needed
    """
    ny, nx = instrument.shape
    common = {
        "render": render.model_dump(),
        "seed": seed,
        "instrument": instrument.name,
        "n_waves": render.n_waves,
        "knot_smoothing": instrument.knot_smoothing,
        "psf": instrument.psf_settings,
    }
    every = exposures_of(table)
    readout: ScaReadout | CcdReadout | None = None
    if calibration is not None:
        if not isinstance(instrument, Roman):
            raise TypeError(f"{instrument.name}: calibrations are those of Roman's SCAs")
        readout = ScaReadout(instrument, calibration, seed)
    elif isinstance(instrument, Rubin):
        readout = CcdReadout(instrument, seed)
        common |= instrument.settings.model_dump(include={"sensor", "cosmic_rays"})
    names = [exposure.name for exposure in every]
    corners = corners_of(table)

    def unit(row: int) -> Unit:
        inputs = truth.inputs(*cone(corners[row]))
        # PSFs are those of a detector and band
        kin = f"{every[row].band}-{every[row].detector}"
        settings = {**common, "row": row, **vars(every[row])}
        if not isinstance(readout, ScaReadout):
            return Unit(names[row], settings, inputs, affinity=kin)
        earlier = before(table, row).tolist()
        # what an exposure leaves depends on its own light alone: on what was before it nothing else depends
        lights = [source for k in earlier for source in truth.inputs(*cone(corners[k]))]
        calibrated = (readout.calibration.stage, readout.calibration.names[readout.unit(every[row])])
        inputs = tuple(dict.fromkeys([*inputs, *lights, calibrated]))
        rays = readout.instrument.settings.cosmic_rays
        settings |= {"before": [vars(every[k]) for k in earlier], "cosmic_rays": rays}
        return Unit(names[row], settings, inputs, prerequisites=tuple(names[k] for k in earlier), affinity=kin)

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

    return ImageProduct(
        stage=stage_of(instrument),
        units=LazyUnits(tuple(names), unit),
        make=RenderExposure(table, truth, instrument, render, seed, readout, store),
        variables=_variables(instrument.shape, readout),
        axes=axes,
        lengths=(len(table),),
        coordinates=coordinates,
        attributes={"survey": instrument.name},
        # image, truth, dq, background and working copies; the wide PSF of one node, as it is sampled or as it is
        # drawn; the objects, and the PSFs of a detector and band, the last and the new
        bytes_per_unit=ny * nx * 28 + 110 * render.largest**2 + (440 << 20),
        # sky, noise and storage, every effect and its calibration; then objects
        seconds_per_unit=ny * nx * ((2.5e-7 if readout is None else 7e-7) + instrument.pixel_scale**2 / 3600 * 0.15),
        tables={"trapped": schema("trapped")} if isinstance(readout, ScaReadout) else {},
    )


def _variables(shape: tuple[int, int], readout: ScaReadout | CcdReadout | None) -> tuple[Variable, ...]:
    """Return the arrays of an exposure, as it is read out."""
    truth = Variable(
        "truth", "float32", shape, ("y", "x"), {"units": "electron", "long_name": "noiseless image of the objects"}
    )
    if isinstance(readout, CcdReadout):
        image, *others = readout.variables
        return image, truth, *others
    full = readout is not None
    bits = {**DQ_FLAGS, **FLAGS} if full else DQ_FLAGS
    masks = {"long_name": "data quality", "flag_masks": list(bits.values()), "flag_meanings": " ".join(bits)}
    electrons = {"units": "electron"}
    said = "calibrated image, sky included" if full else "observed image"
    found = [
        ("image", "float32" if full else "int32", {**electrons, "long_name": said}),
        ("dq", "uint16" if full else "uint8", masks),
    ]
    if full:
        found += [
            ("raw", "uint16", {"units": "DN", "long_name": "what was read"}),
            ("variance", "float32", {"units": "electron2", "long_name": "variance of the image"}),
        ]
    image, *others = (Variable(name, kind, shape, ("y", "x"), attributes) for name, kind, attributes in found)
    return image, truth, *others


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


def cone(corners: np.ndarray) -> tuple[float, float, float, float]:
    """Return centre and radii (degrees) of the cones around a footprint from which galaxies and stars shine on it."""
    vectors = unit_vectors(corners[:, 0], corners[:, 1])
    centre = vectors.sum(axis=0)
    centre /= np.linalg.norm(centre)
    ra, dec = radec(centre)
    radius = np.degrees(2 * np.arcsin(np.linalg.norm(vectors - centre, axis=1).max() / 2))
    return float(ra), float(dec), float(radius + REACH / 3600), float(radius + STAR_REACH / 3600)


def header_text(header: dict) -> str:
    """Return the cards of a header as one text, exact to the last digit of every value."""
    return fits.Header([(key, value) for key, value in header.items()]).tostring(endcard=True)


def wcs_of(text: str) -> WCS:
    """Return the WCS of a header text."""
    return WCS(fits.Header.fromstring(text))
