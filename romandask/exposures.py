"""Exposures: for each detector of each visit the observed image, the noiseless true one and the dq plane."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import galsim
import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, Instrument, exposure_of, exposures_of
from romandask.kernels.detector import DQ_FLAGS, observe
from romandask.kernels.galsim_engine import draw_objects
from romandask.kernels.render import Stamps, draw, plan_stamps
from romandask.kernels.scene import Drawable, Truth, build_scene
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

    def view(self, index: int) -> View:
        """Return what the exposure at a row of the pointings table looks at."""
        exposure, instrument = exposure_of(self.table.iloc[index]), self.instrument
        header = instrument.header(exposure)
        truth = self.truth.near(*cone(corners_of(self.table.iloc[[index]])[0]))
        drawable = build_scene(
            truth, WCS(header), instrument.bandpass(exposure.band), exposure.exptime, instrument.knot_smoothing,
            (instrument.shape, STAR_REACH / instrument.pixel_scale),
        )  # fmt: skip
        background = instrument.background(exposure, header)
        faintest = self.render.truncation * instrument.sky_noise(exposure, background)
        stamps = plan_stamps(
            drawable.scene, instrument.psf_edges(exposure), instrument.shape, faintest, self.render.largest,
            instrument.bright_psfs(exposure),
        )  # fmt: skip
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

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return image, truth and dq of the exposure at a row of the pointings table."""
        view = self.view(index)
        expected = self.expected(view)
        random = rng(self.seed, "exposures", self.instrument.name, view.exposure.visit, view.exposure.detector)
        image, dq = observe(expected, view.background, self.instrument.detector, random)
        return {"image": image, "truth": expected, "dq": dq}


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
        # PSFs are those of a detector and band
        kin = f"{every[row].band}-{every[row].detector}"
        return Unit(names[row], {**common, "row": row, **vars(every[row])}, inputs, kin=kin)

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
        # image, truth, dq, background and working copies; the wide PSF of one node, as GalSim samples it or as it is
        # drawn; the objects, and the PSFs of a detector and band, the last and the new
        bytes_per_unit=ny * nx * 28 + 110 * render.largest**2 + (500 << 20),
        # sky, noise and storage; then objects
        seconds_per_unit=ny * nx * 2.5e-7 + ny * nx * instrument.pixel_scale**2 / 3600 * 600 * 2.5e-4,
    )


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
