"""Exposures: for each detector of each visit the observed image, the noiseless true one and the dq plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.wcs import WCS

from romandask.instruments.exposure import Instrument, exposure_of, exposures_of
from romandask.kernels.detector import DQ_FLAGS, observe
from romandask.kernels.render import Scene, component_reach, draw, largest_stamp
from romandask.kernels.scene import build_scene
from romandask.model.config import RenderSettings
from romandask.model.seeds import rng
from romandask.model.sky import radec, unit_vectors
from romandask.pointings import corners_of
from romandask.runtime.products import Coordinates, ImageProduct
from romandask.runtime.store import Variable
from romandask.runtime.units import LazyUnits, Unit
from romandask.truth import TruthCatalogs

REACH = 30.0
"""Objects this far outside a detector, arcsec, may shine on it."""


@dataclass(frozen=True)
class RenderExposure:
    """Makes the arrays of one exposure."""

    table: pd.DataFrame
    truth: TruthCatalogs
    instrument: Instrument
    render: RenderSettings
    seed: int

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, truth and dq of the exposure at a row of the pointings table."""
        exposure = exposure_of(self.table.iloc[index])
        header = self.instrument.header(exposure)
        ra, dec, radius = cone(corners_of(self.table.iloc[[index]])[0])
        truth = self.truth.near(ra, dec, radius)
        bandpass = self.instrument.bandpass(exposure.band)
        scene = build_scene(truth, WCS(header), bandpass, exposure.exptime, self.instrument.knot_smoothing)
        background = self.instrument.background(exposure, header)
        faintest = self.render.truncation * self.instrument.sky_noise(exposure, background)
        basis = self.instrument.psf(exposure, scene_stamp(scene, faintest, self.render.largest))
        expected = draw(scene, basis, self.instrument.shape, faintest)
        random = rng(self.seed, "exposures", self.instrument.name, exposure.visit, exposure.detector)
        image, dq = observe(expected, background, self.instrument.detector, random)
        return {"image": image, "truth": expected, "dq": dq}


def exposures(
    table: pd.DataFrame, truth: TruthCatalogs, instrument: Instrument, render: RenderSettings, seed: int
) -> ImageProduct:
    """Return the lazy exposures of a pointings table: dims (exposure, y, x)."""
    ny, nx = instrument.shape
    common = {
        "render": render.model_dump(),
        "seed": seed,
        "instrument": instrument.name,
        "n_waves": render.n_waves,
        "knot_smoothing": instrument.knot_smoothing,
    }
    every = exposures_of(table)
    names = [exposure.name for exposure in every]
    corners = corners_of(table)

    def unit(row: int) -> Unit:
        inputs = truth.inputs(*cone(corners[row]))
        return Unit(names[row], {**common, "row": row, **vars(every[row])}, inputs)

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

    flags = {"flag_masks": list(DQ_FLAGS.values()), "flag_meanings": " ".join(DQ_FLAGS)}
    planes = (
        Variable("image", "int32", (ny, nx), ("y", "x"), {"units": "electron", "long_name": "observed image"}),
        Variable(
            "truth",
            "float32",
            (ny, nx),
            ("y", "x"),
            {"units": "electron", "long_name": "noiseless image of the objects"},
        ),
        Variable("dq", "uint8", (ny, nx), ("y", "x"), {"long_name": "data quality", **flags}),
    )
    return ImageProduct(
        f"exposures/{instrument.name}",
        LazyUnits(tuple(names), unit),
        RenderExposure(table, truth, instrument, render, seed),
        planes,
        axes,
        (len(table),),
        coordinates,
        {"survey": instrument.name},
        # image, truth, dq, background and working copies; two PSF bases, the last and the new; the objects
        bytes_per_unit=ny * nx * 28 + 2 * render.n_waves * 36 * render.largest**2 + (150 << 20),
        # sky, noise and storage; then objects
        seconds_per_unit=ny * nx * 2.5e-7 + ny * nx * instrument.pixel_scale**2 / 3600 * 600 * 2.5e-4,
    )


def cone(corners: np.ndarray) -> tuple[float, float, float]:
    """Return centre and radius (degrees) of the cone around a footprint, with the reach of light into it."""
    vectors = unit_vectors(corners[:, 0], corners[:, 1])
    centre = vectors.sum(axis=0)
    centre /= np.linalg.norm(centre)
    ra, dec = radec(centre)
    radius = np.degrees(2 * np.arcsin(np.linalg.norm(vectors - centre, axis=1).max() / 2))
    return float(ra), float(dec), float(radius + REACH / 3600)


def scene_stamp(scene: Scene, faintest: float, largest: int) -> int:
    """Return the largest stamp that a scene needs."""
    brightest = float(scene.fluxes().max(initial=0.0))
    return largest_stamp(brightest, component_reach(scene, faintest), faintest, largest)


def header_text(header: dict) -> str:
    """Return the cards of a header as one text, exact to the last digit of every value."""
    return fits.Header([(key, value) for key, value in header.items()]).tostring(endcard=True)


def wcs_of(text: str) -> WCS:
    """Return the WCS of a header text."""
    return WCS(fits.Header.fromstring(text))
