"""Rendering of one exposure: the scene of a detector is drawn without noise, then read out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import galsim
import numpy as np
import pandas as pd
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of
from romandask.instruments.instrument import Instrument, Readout
from romandask.kernels.coadding.background import background_mesh
from romandask.kernels.detectors.simple_detector import WHOLE, usable
from romandask.kernels.rendering.draw import draw
from romandask.kernels.rendering.galsim_engine import draw_objects
from romandask.kernels.rendering.scene import Drawable, Truth, Within, build_scene
from romandask.kernels.rendering.stamps import Scene, Stamps, component_extents, component_radii, plan_stamps
from romandask.kernels.rendering.wings import add_wings
from romandask.model.settings import RenderSettings
from romandask.model.sky import radec, unit_vectors
from romandask.products.images import table_beside
from romandask.products.tables import to_frame
from romandask.stages.exposures.drawn_area import DrawnArea, Window
from romandask.stages.pointings import corners_of
from romandask.stages.psf_models import Psfs
from romandask.stages.truth.truth_catalogs import TruthCatalogs
from romandask.storage.manifest import read_record
from romandask.storage.store import Store, read_parquet

REACH = 30.0
"""Distance from a detector within which galaxies are taken into account, arcsec."""
STAR_REACH = 115.0
"""As REACH, for stars; it is larger because the diffraction spikes of bright stars are long."""
_SKY_SAMPLE = slice(None, None, 32)
"""Rows, and columns, of a detector from which the mean sky is taken."""


@dataclass(frozen=True, kw_only=True)
class View:
    """The scene and the background of one exposure, before the detector."""

    exposure: Exposure
    instrument: Instrument
    psfs: Psfs
    render: RenderSettings
    header: dict[str, Any]
    """FITS header with the WCS."""
    truth: Truth
    """Rows of the truth catalogs near the detector."""
    drawable: Drawable
    """The objects that can be drawn."""
    background: np.ndarray
    """Expected electrons that do not come from objects, shape (ny, nx); 0 outside `window`."""
    window: Window
    """Rows and columns that are drawn."""
    faintest: float
    """Largest surface brightness at the edge of a stamp, electrons/pixel."""
    stamps: Stamps
    """Stamps of the objects of the scene."""

    @property
    def scene(self) -> Scene:
        """The n drawable objects, in pixels and electrons."""
        return self.drawable.scene

    @property
    def stamp_sizes(self) -> np.ndarray:
        """Side of the stamp of each object, shape (n,), pixels; 0 for an object that is not drawn."""
        return self.stamps.size

    @property
    def shown(self) -> np.ndarray:
        """True for the objects, shape (n,), whose stamps overlap the part of the detector that is drawn."""
        shown, half = self.stamps.size > 0, self.stamps.size // 2
        for part, side, position in zip(self.window, self.background.shape, (self.scene.y, self.scene.x), strict=True):
            start, stop, _ = part.indices(side)
            shown &= (position > start - half) & (position < stop - 1 + half)
        return shown

    def expected(self, chosen: np.ndarray | None = None) -> np.ndarray:
        """Return the noiseless image of the objects, shape (ny, nx), electrons.

        Parameters
        ----------
        chosen : ndarray of bool, shape (n,), optional
            True for the objects to draw; by default all are drawn.
        """
        instrument, exposure, stamps = self.instrument, self.exposure, self.stamps
        if chosen is not None:
            stamps = stamps.only(chosen)
        psf = self.psfs.model(exposure)
        if self.render.engine == "galsim":
            profiles = Profiles(instrument, exposure)
            image = draw_objects(self.scene, profiles, instrument.shape, stamps, instrument.pixel_scale)
            radii = component_extents(self.scene), component_radii(self.scene, self.faintest)
            add_wings(image, self.scene, radii, psf.rings, stamps)
            return image
        return draw(self.scene, psf, instrument.shape, stamps, self.faintest, self.psfs.bright(exposure))

    def profiles(self, x: float, y: float) -> tuple[Any, list[galsim.GSObject]]:
        """Return the cell of a position on the detector, and GalSim's PSFs there, one per PSF node."""
        return Profiles(self.instrument, self.exposure)(x, y)


@dataclass(frozen=True, kw_only=True)
class RenderExposure:
    """Makes the arrays of one exposure."""

    table: pd.DataFrame
    """Pointings table (schema: catalogs/pointings.yaml); its rows are the units."""
    truth: TruthCatalogs
    instrument: Instrument
    render: RenderSettings
    seed: int
    """Seed of the survey."""
    readout: Readout
    """The detector model."""
    psfs: Psfs
    """PSFs of the exposures."""
    area: DrawnArea | None = None
    """Tiles for which parts of detectors are drawn; None to draw whole detectors."""
    store: Store | None = None
    """Store that the tables of earlier exposures are read from; without one they are computed."""

    def view(self, index: int) -> View:
        """Return the scene and the background of the exposure in a row of the pointings table."""
        exposure, instrument = exposure_of(self.table.iloc[index]), self.instrument
        header = instrument.header(exposure)
        truth = self.truth.near(*cone(corners_of(self.table.iloc[[index]])[0]))
        frame = WCS(header)
        window = WHOLE if self.area is None else self.area.window(index, frame, instrument.shape)
        drawable = build_scene(
            truth,
            frame,
            instrument.bandpass(exposure.band),
            exposure.exptime,
            instrument.knot_smoothing,
            Within(instrument.shape, REACH / instrument.pixel_scale, STAR_REACH / instrument.pixel_scale),
        )
        background = np.zeros(instrument.shape, np.float32)
        background[window] = instrument.background(exposure, header, *window)
        # the mean sky of the whole detector, whatever part is drawn
        sky = instrument.background(exposure, header, _SKY_SAMPLE, _SKY_SAMPLE)
        faintest = self.render.truncation * instrument.sky_noise(exposure, sky)
        stamps = plan_stamps(
            drawable.scene,
            self.psfs.edges(exposure),
            instrument.shape,
            faintest,
            self.render.largest,
            self.psfs.bright(exposure),
        )
        return View(
            exposure=exposure,
            instrument=instrument,
            psfs=self.psfs,
            render=self.render,
            header=header,
            truth=truth,
            drawable=drawable,
            background=background,
            window=window,
            faintest=faintest,
            stamps=stamps,
        )

    def __call__(self, index: int) -> dict[str, Any]:
        """Return the arrays and tables, by name, of the exposure in a row of the pointings table."""
        arrays = self.readout(self.view(index), self.left(index))
        # what coadds need of the whole exposure is found once, so that they can read windows of it
        return {**arrays, "background_mesh": background_mesh(arrays["image"], ~usable(arrays["dq"]))}

    def left(self, index: int) -> list[tuple[Exposure, pd.DataFrame]]:
        """Return the earlier exposures whose trapped charge affects an exposure, each with its table of that charge."""
        rows = self.readout.earlier(self.table, index).tolist()
        return [(exposure_of(self.table.iloc[row]), self.left_by(row)) for row in rows]

    def left_by(self, index: int) -> pd.DataFrame:
        """Return the table of trapped charge that an exposure leaves: read if it is stored, otherwise computed."""
        exposure, stage = exposure_of(self.table.iloc[index]), stage_of(self.instrument)
        if self.store is not None and read_record(self.store, stage, exposure.name):
            (table_name,) = self.readout.tables
            return to_frame(read_parquet(table_beside(self.store, stage, table_name, exposure.name)))
        return self.readout.leave(self.view(index))


@dataclass(frozen=True, eq=False)
class Profiles:
    """GalSim's PSFs of an exposure on a coarse grid of cells, for the GalSim engine."""

    instrument: Instrument
    exposure: Exposure
    cells: int = 4
    """Number of cells along each side of the detector. An object is drawn with the PSF at the centre of its cell."""

    def __call__(self, x: float, y: float) -> tuple[tuple[int, int], list[galsim.GSObject]]:
        """Return the cell of a position on the detector, pixels, and the PSFs of the cell, one per PSF node."""
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
    """Return the name of the product with the exposures of an instrument."""
    return f"exposures/{instrument.name}"


def cone(corners: np.ndarray) -> tuple[float, float, float, float]:
    """Return the cones around a footprint that contain all galaxies and stars with light on it.

    Parameters
    ----------
    corners : ndarray, shape (4, 2), degrees
        Corners of the footprint.

    Returns
    -------
    ra, dec : float, degrees
        Centre of both cones.
    galaxy_radius, star_radius : float, degrees
        Radii of the cones.
    """
    vectors = unit_vectors(corners[:, 0], corners[:, 1])
    centre = vectors.sum(axis=0)
    centre /= np.linalg.norm(centre)
    ra, dec = radec(centre)
    radius = np.degrees(2 * np.arcsin(np.linalg.norm(vectors - centre, axis=1).max() / 2))
    return float(ra), float(dec), float(radius + REACH / 3600), float(radius + STAR_REACH / 3600)
