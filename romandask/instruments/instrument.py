"""What every telescope offers to the stages: the protocols of an instrument, of its readout and of its settings.

A telescope is a folder beside this module and one line in `romandask.pipeline`. No other room knows its name: what
differs between telescopes is asked of `Instrument`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol

import galsim
import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.rendering.draw import Scene
from romandask.kernels.rendering.psf import BrightPsf, PsfModel
from romandask.model.settings import Section
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct
from romandask.storage.arrays import Variable
from romandask.storage.paths import AnyPath


@dataclass(frozen=True, kw_only=True)
class InstrumentContext:
    """What an instrument takes from the other sections of a pipeline."""

    n_waves: int
    """Wavelengths across a band at which PSFs are computed."""
    seed: int
    """Of the survey."""
    data: AnyPath
    """Folder that the paths of source files are relative to."""


class InstrumentSettings(Section, ABC):
    """The block of an instrument in a pipeline."""

    every_band: ClassVar[tuple[str, ...]]
    """Bands that the instrument has."""
    usual_reference_band: ClassVar[str]
    """Its reference band, where a pipeline has it."""
    bands: Any
    pointings: Any
    """Its section `pointings`, with `source` and `path`."""

    @abstractmethod
    def instrument(self, context: InstrumentContext) -> Instrument:
        """Return the instrument with these settings."""


@dataclass(frozen=True, kw_only=True)
class Publication:
    """Published figures of a survey, beside which the report puts its own."""

    source: str
    depths: Mapping[str, float] = field(default_factory=dict)
    """5-sigma depth of point sources by band, AB mag."""
    galaxies: float | None = None
    """Detected galaxies a square degree."""
    stars: float | None = None
    """Detected stars a square degree."""


class Light(Protocol):
    """The light on one exposure, before the detector: what a readout turns into data."""

    exposure: Exposure
    background: np.ndarray
    """(ny, nx) expected electrons that do not come from objects."""

    @property
    def scene(self) -> Scene:
        """The objects, in pixels and electrons."""

    @property
    def stamp_sizes(self) -> np.ndarray:
        """(n,) pixels along a side of the stamp of each object; 0 for one that is not drawn."""

    def expected(self, chosen: np.ndarray | None = None) -> np.ndarray:
        """Return the noiseless image (ny, nx), electrons, of the objects, or of those where `chosen` (n,) is true."""

    def profiles(self, x: float, y: float) -> tuple[Any, list[galsim.GSObject]]:
        """Return the cell of a position and GalSim's PSFs there, one a node."""


class Readout(Protocol):
    """A detector: turns light into what an exposure stores."""

    @property
    def variables(self) -> tuple[Variable, ...]:
        """The arrays of an exposure beside the noiseless image, `image` first."""

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """Tables that are stored with an exposure: what it leaves to later ones."""

    @property
    def seconds_per_pixel(self) -> float:
        """Time of a core that sky, noise, detector and storage take, as measured on a laptop."""

    @property
    def settings(self) -> dict[str, Any]:
        """What the arrays depend on, beside the settings that all instruments share."""

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return the rows of a pointings table whose exposures leave charge in that of a row, in order of time."""

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return the (stage, unit) that an exposure reads, beside the truth."""

    def leave(self, light: Light) -> pd.DataFrame:
        """Return the table that an exposure leaves to later ones."""

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Return the arrays of an exposure by name, the noiseless `truth` among them, and its tables.

        Parameters
        ----------
        light : Light
        left : sequence of (Exposure, DataFrame)
            Earlier exposures and what they left.
        """


class Instrument(Protocol):
    """A telescope and its camera, as the stages see it."""

    name: str
    """Of its block in a pipeline, and of its products."""
    title: str
    """For people: `Roman`."""
    facility: tuple[str, str]
    """Names of the telescope and of the camera, as archives write them."""
    code: int
    """Unique number among all instruments, 0 to 7: part of the keys of friends of friends."""
    blend_role: Literal["sharp", "blended"] | None
    """Part in the count of unrecognised blends: objects of the blended survey that are several of the sharp one."""
    data_model_elements: Mapping[str, str]
    """By band, the name of the optical element in the mission's own data models (roman_datamodels); empty where there
    are none for this telescope."""
    publication: Publication | None
    """Published figures, for the report."""
    coadd_scale: float
    """Pixel scale of its coadds, arcsec."""
    pixel_scale: float
    """Native, arcsec."""
    shape: tuple[int, int]
    """Detector (ny, nx)."""
    field_radius: float
    """No detector reaches further from the boresight, degrees."""
    knot_smoothing: float
    """Sigma, arcsec, of the Gaussian that smooths knots of galaxies."""
    detector: Detector
    aperture: float
    """Radius of aperture photometry, arcsec: it holds most of the light of a point source."""
    detection: Literal["median", "peaks"]
    """median: Source Extractor on the median of bands; peaks: those of their weighted mean, smoothed with its PSF."""
    detection_bands: tuple[str, ...] | None
    """Bands that enter it; None for all."""

    visit_seconds: float
    """Exposure time of one visit where the weight of a coadd is not its exposure time."""

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""

    @property
    def reference_band(self) -> str:
        """Band in which objects are counted and compared with the truth."""

    @property
    def colour_band(self) -> str:
        """Band of the colour between two surveys' counterparts of an object."""

    @property
    def picture_bands(self) -> tuple[str, ...]:
        """Bands of this pipeline from red to blue, for colour pictures."""

    @property
    def psf_settings(self) -> dict[str, object]:
        """What PSFs depend on but the exposure: a part of the hash of what is drawn with them."""

    @property
    def coadd(self) -> Literal["drizzle", "warp", "draw"]:
        """How tiles are made: drizzled or warped from exposures, or drawn directly from the cadence."""

    @property
    def calibrated(self) -> bool:
        """True where exposures are made with the calibrations of their detectors."""

    def calibrations(self, detectors: Sequence[int]) -> ImageProduct | None:
        """Return the lazy calibrations of some detectors; None where the instrument has none."""

    def readout(self, seed: int, calibration: ImageProduct | None) -> Readout:
        """Return the detector.

        Parameters
        ----------
        seed : int
            Of the survey.
        calibration : ImageProduct or None
            What `calibrations` returned, stored or not; None where the instrument is not calibrated.
        """

    def effects(
        self,
        readout: Readout,
        light: Light,
        expected: np.ndarray,
        left: Sequence[tuple[Exposure, pd.DataFrame]],
    ) -> dict[str, np.ndarray]:
        """Return what each effect of the detector does around the brightest object: images (n, n), electrons.

        Empty where the detector has no effects that can be taken apart.
        """

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass, with the wavelengths at which the PSF is known."""

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Return visits that cover a region: the columns of Exposure without the detector."""

    @property
    def detectors(self) -> tuple[int, ...]:
        """Numbers of the detectors."""

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners (n, detectors, 4, 2), degrees, of every detector of visits (columns ra, dec, pa)."""

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """True where the telescope cannot point there and then (columns ra, dec, mjd)."""

    def header(self, exposure: Exposure) -> dict:
        """Return the exact FITS header of an exposure."""

    def psf(self, exposure: Exposure) -> PsfModel:
        """Return the chromatic PSF of an exposure."""

    def psf_at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF at one place, exactly: of no use elsewhere, and sooner made than the whole."""

    def psf_key(self, exposure: Exposure) -> tuple:
        """Return what tells the PSFs of exposures apart: where it is the same they are."""

    def psf_edges(self, exposure: Exposure) -> dict[int, float]:
        """Return `edges` of that PSF, without the work of the whole."""

    def bright_psfs(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the PSFs of its bright stars, the brightest last."""

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return GalSim's PSFs (arcsec, in the frame of the pixels, without their response), one a node, at a place."""

    def background(self, exposure: Exposure, header: dict, rows: slice = ..., columns: slice = ...) -> np.ndarray:
        """Return the expected electrons (ny, nx) that do not come from objects, of all or some pixels."""

    def sky_noise(self, exposure: Exposure, background: np.ndarray) -> float:
        """Return the noise of an empty pixel, electrons rms."""

    def pixel_noise(self, exposure: Exposure) -> float:
        """Return the noise of an empty pixel, electrons rms, without making the image of the background."""

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray) -> PsfModel:
        """Return the weighted mean PSF of some exposures of one band, for tiles that are drawn from the cadence."""
