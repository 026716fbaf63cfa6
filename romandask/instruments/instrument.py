"""Interface between the stages and a telescope: the protocol `Instrument`, and the base class of its settings.

Each telescope is a folder in this package and one field of `romandask.pipeline.Pipeline`. The stages do not know any
telescope by name; they use the members of `Instrument`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Protocol

import galsim
import numpy as np
import pandas as pd

from romandask.instruments.exposure import Exposure
from romandask.instruments.readout import Light, Readout
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.rendering.psf import BrightPsf, PsfModel
from romandask.kernels.rendering.psf_layout import PsfLayout
from romandask.model.settings import Section
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct
from romandask.storage.paths import AnyPath


@dataclass(frozen=True, kw_only=True)
class InstrumentContext:
    """Values from other sections of a pipeline that an instrument needs."""

    n_waves: int
    """Number of wavelengths per band at which PSFs are computed."""
    seed: int
    """Seed of the survey."""
    data: AnyPath
    """Folder to which the paths of source files are relative."""


class PointingSettings(Section):
    """Base class of the `pointings` section of an instrument."""

    source: str
    """Format of the file with the list of visits (obseq, opsim), or the name of the instrument's own plan."""
    path: str | None = None
    """File with the list of visits, relative to `data`."""

    @property
    def read_options(self) -> dict[str, str | None]:
        """Further arguments of the reader of `source`."""
        return {}


class InstrumentSettings(Section, ABC):
    """Base class of the section of an instrument in a pipeline."""

    every_band: ClassVar[tuple[str, ...]]
    """Names of all bands of the instrument."""
    usual_reference_band: ClassVar[str]
    """Reference band of the instrument when the pipeline includes this band."""
    bands: tuple[str, ...]
    """Bands to simulate."""
    pointings: PointingSettings
    """Source of the visits."""

    @abstractmethod
    def instrument(self, context: InstrumentContext) -> Instrument:
        """Return the instrument with these settings."""


@dataclass(frozen=True, kw_only=True)
class Publication:
    """Published results of a survey, which the report compares with its own."""

    source: str
    """Citation."""
    depths: Mapping[str, float] = field(default_factory=dict)
    """5-sigma depth of point sources in each band, AB mag."""
    galaxies: float | None = None
    """Detected galaxies per square degree."""
    stars: float | None = None
    """Detected stars per square degree."""


class Instrument(Protocol):
    """A telescope and its camera.

    Members are grouped by subject: names, bands, pointings and coordinates, PSF, background, detector, and coadds with
    their detection. Pixel coordinates x, y are 0 at the centre of the first pixel. A node is one of the wavelengths of
    a band at which the PSF is computed (`Bandpass.nodes`).
    """

    # names

    @property
    def name(self) -> str:
        """Name of the instrument's section in a pipeline and of its products, for example `roman`."""

    @property
    def title(self) -> str:
        """Name in reports, for example `Roman`."""

    @property
    def facility(self) -> tuple[str, str]:
        """Names of the telescope and of the camera, as archives write them."""

    @property
    def code(self) -> int:
        """Number from 0 to 7, unique among all instruments; part of the keys in friends-of-friends matching."""

    @property
    def blend_role(self) -> Literal["sharp", "blended"] | None:
        """Role in the count of unrecognised blends, or None for none.

        An unrecognised blend is one object of the blended survey that is several objects of the sharp survey.
        """

    @property
    def data_model_elements(self) -> Mapping[str, str]:
        """Optical element of each band in the mission's data models (roman_datamodels); empty if there are none."""

    @property
    def publication(self) -> Publication | None:
        """Published results for comparison in the report."""

    # bands

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""

    @property
    def reference_band(self) -> str:
        """Band in which objects are counted and compared with the truth."""

    @property
    def colour_band(self) -> str:
        """Band for the colour of an object between its counterparts in two surveys."""

    @property
    def picture_bands(self) -> tuple[str, ...]:
        """Bands of this pipeline for colour pictures, ordered from red to blue."""

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass with its PSF nodes."""

    # pointings and coordinates

    @property
    def detectors(self) -> tuple[int, ...]:
        """Numbers of the detectors."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a detector (ny, nx), pixels."""

    @property
    def pixel_scale(self) -> float:
        """Native pixel scale, arcsec."""

    @property
    def field_radius(self) -> float:
        """Upper limit of the distance of any pixel from the boresight, degrees."""

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Generate the visits that cover a region.

        Parameters
        ----------
        region : Region
            Region to cover.
        seed : int
            Seed of the survey.

        Returns
        -------
        DataFrame
            One row per visit, with the fields of `Exposure` except `detector`. `seeing`, `airmass` and
            `sky_brightness` are NaN for a telescope in space. More columns are allowed.
        """

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners of all detectors of n visits.

        The computation is vectorised over visits, because pointings are tested against the region by the hundred
        thousand.

        Parameters
        ----------
        visits : DataFrame
            Columns ra, dec and pa, degrees.

        Returns
        -------
        ndarray, shape (n, detectors, 4, 2), degrees
            Right ascension and declination of the corners, in the order of `exposure.footprint`.
        """

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """Return a mask, shape (n,), of the visits at which the telescope must not point.

        Parameters
        ----------
        visits : DataFrame
            Columns ra and dec, degrees, and mjd.
        """

    def header(self, exposure: Exposure) -> dict:
        """Return the FITS header of the exact WCS of an exposure; every stage takes its WCS from this header."""

    # PSF

    @property
    def psf_settings(self) -> dict[str, object]:
        """Settings on which PSFs depend; part of the input hash of images that are drawn with the PSFs."""

    @property
    def psf_layout(self) -> PsfLayout | None:
        """Largest sizes of the PSF models in any band, or None if each exposure has a PSF of its own.

        With a layout, all exposures of a detector and band must have the same PSF: it is then sampled once, in a stage
        of its own, and stored.
        """

    def psf(self, exposure: Exposure) -> PsfModel:
        """Return the chromatic PSF of an exposure, as it varies over the detector."""

    def psf_at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF at one position, pixels, exact there and faster to compute than `psf`.

        The model does not vary over the detector and must not be used at other positions.
        """

    def psf_key(self, exposure: Exposure) -> tuple:
        """Return a hashable key; exposures with equal keys have equal PSFs."""

    def psf_edges(self, exposure: Exposure) -> dict[int, float]:
        """Return `PsfModel.edges` of the PSF of an exposure, if possible without computing the whole model."""

    def bright_psfs(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the larger and more detailed PSFs of bright stars, in increasing order of brightness; may be empty."""

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return the PSF at a position, pixels, as GalSim profiles, one per node.

        Profiles are in arcsec, with axes along the pixel grid, and do not include the response of a pixel. They are an
        independent implementation of `psf`: the tests draw with both and compare.
        """

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray) -> PsfModel:
        """Return the weighted mean PSF of exposures of one band, on native pixels, for tiles drawn directly.

        Parameters
        ----------
        exposures : list of Exposure
            Exposures of one band.
        weights : ndarray, shape (n,)
            Weight of each exposure; the sum need not be 1.

        Raises
        ------
        NotImplementedError
            If `coadd` is never "draw" for this instrument.
        """

    @property
    def knot_smoothing(self) -> float:
        """Sigma of the Gaussian that smooths each knot of a galaxy, arcsec; 0 for point-like knots."""

    # background and noise

    def background(self, exposure: Exposure, header: dict, rows: slice = ..., columns: slice = ...) -> np.ndarray:
        """Return the expected electrons that do not come from objects: sky, thermal emission and dark current.

        Parameters
        ----------
        exposure : Exposure
            The exposure.
        header : dict
            Its FITS header, from `header`.
        rows, columns : slice, optional
            Part of the detector; by default the whole detector.

        Returns
        -------
        ndarray, shape (ny, nx), float32, electrons
        """

    def sky_noise(self, exposure: Exposure, background: np.ndarray) -> float:
        """Return the mean noise of an empty pixel, electrons rms, given the image of the background, electrons."""

    def pixel_noise(self, exposure: Exposure) -> float:
        """Return the mean noise of an empty pixel, electrons rms, if possible without an image of the background."""

    # detector

    @property
    def detector(self) -> Detector:
        """Saturation and read noise."""

    @property
    def calibrated(self) -> bool:
        """True if exposures are simulated with calibrations of the detectors."""

    def calibrations(self, detectors: Sequence[int]) -> ImageProduct | None:
        """Return the lazy calibrations of some detectors; None if the instrument is not calibrated."""

    def readout(self, seed: int, calibration: ImageProduct | None) -> Readout:
        """Return the readout of the detectors.

        Parameters
        ----------
        seed : int
            Seed of the survey.
        calibration : ImageProduct or None
            Result of `calibrations`, stored or not; None if the instrument is not calibrated.
        """

    def effects(
        self,
        readout: Readout,
        light: Light,
        expected: np.ndarray,
        left: Sequence[tuple[Exposure, pd.DataFrame]],
    ) -> dict[str, np.ndarray]:
        """Return images of the change that each detector effect makes around the brightest object of an exposure.

        Parameters
        ----------
        readout : Readout
            Result of `readout`.
        light : Light
            The light of the exposure.
        expected : ndarray, shape (ny, nx), electrons
            Noiseless image of the objects, `light.expected()`.
        left : sequence of (Exposure, DataFrame)
            Earlier exposures and their tables, as for `Readout`.

        Returns
        -------
        dict of str to ndarray, shape (n, n), electrons
            Images by name of the effect, in the order in which the effects act; empty if the effects of the detector
            cannot be separated.
        """

    # coadds and detection

    @property
    def coadd(self) -> Literal["drizzle", "warp", "draw"]:
        """Method of coaddition: drizzle or warp exposures, or draw tiles directly from the cadence."""

    @property
    def coadd_scale(self) -> float:
        """Pixel scale of coadds, arcsec."""

    @property
    def visit_seconds(self) -> float:
        """Exposure time of one visit, seconds.

        Converts flux to electrons on coadds whose weight is not an exposure time (`coadd` "warp" and "draw").
        """

    @property
    def aperture(self) -> float:
        """Radius of aperture photometry, arcsec; the aperture contains most of the light of a point source."""

    @property
    def detection(self) -> Literal["median", "peaks"]:
        """Method of detection.

        - median: Source Extractor on the median of the detection bands.
        - peaks: peaks of the weighted mean of the detection bands, smoothed with its PSF.
        """

    @property
    def detection_bands(self) -> tuple[str, ...] | None:
        """Bands that are combined for detection; None for all bands."""
