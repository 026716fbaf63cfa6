"""Rubin's LSST camera: 189 detectors, the atmosphere, and a cadence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator

from romandask.instruments.exposure import WHOLE, Exposure, pixel_areas
from romandask.kernels.bandpasses import rubin_bandpass
from romandask.kernels.detector import Detector
from romandask.kernels.psf import PsfBasis, radial_basis
from romandask.model.config import Section
from romandask.model.seeds import rng
from romandask.model.sky import Region, from_tangent_plane, unit_vectors
from romandask.model.spectra import Bandpass

SCALE = 0.2
"""arcsec a pixel"""
AREA = np.pi / 4 * 642.3**2
"""Effective collecting area, cm2."""
DARK = 0.2
"""Electrons a second."""
SYSTEM_FWHM = 0.4
"""Telescope and camera, arcsec at airmass 1."""
FIELD_AREA = 9.6
"""Field of view, square degrees."""
SKY = {"u": 22.7, "g": 22.1, "r": 21.1, "i": 20.4, "z": 19.5, "y": 18.6}
"""Median sky brightness, AB mag / arcsec2."""


class RubinPointings(Section):
    """Where Rubin looks: an OpSim database, or a generated five-year cadence."""

    source: Literal["cadence", "opsim"] = "cadence"
    path: str | None = Field(None, description="OpSim SQLite file, below `data`")
    start: float = Field(60980.0, description="first night of the cadence, MJD")
    visits: dict[str, int] = Field(
        {"u": 28, "g": 40, "r": 92, "i": 92, "z": 80, "y": 80}, description="mean visits of a point, by band"
    )
    seeing: float = Field(0.6, gt=0, description="median atmospheric FWHM at 500 nm and zenith, arcsec")


class RubinSettings(Section):
    """The Rubin block of a pipeline."""

    bands: tuple[Literal["u", "g", "r", "i", "z", "y"], ...] = ("u", "g", "r", "i", "z", "y")
    mode: Literal["coadd"] = "coadd"
    pointings: RubinPointings = RubinPointings()

    @model_validator(mode="after")
    def _every_band_visited(self) -> RubinSettings:
        missing = [band for band in self.bands if band not in self.pointings.visits]
        if missing and self.pointings.source == "cadence":
            raise ValueError(f"pointings.visits has no entry for {', '.join(missing)}")
        return self


@dataclass(frozen=True)
class Rubin:
    """What the stages need to know of Rubin."""

    settings: RubinSettings
    n_waves: int = 5
    name: str = "rubin"
    coadd_scale: float = SCALE
    pixel_scale: float = SCALE
    shape: tuple[int, int] = (4000, 4072)
    field_radius: float = 1.9
    knot_smoothing: float = 0.0
    aperture: float = 1.5
    detection: Literal["median", "mean"] = "mean"
    detection_bands: tuple[str, ...] | None = None
    coadd_from: Literal["exposures", "pointings"] = "pointings"
    detector: Detector = Detector(saturation=1e5, read_noise=9.0)

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""
        return self.settings.bands

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass with this instrument's PSF nodes."""
        return rubin_bandpass(band, self.n_waves, AREA)

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Return a generated cadence: a fixed field grid, nightly translational dithers, rotations at filter changes.

        Visits of a field are spread over five years; seeing and airmass are log-normal and uniform in altitude, sky
        brightness scatters by 0.3 mag about the band's median.
        """
        settings = self.settings.pointings
        spacing = 2.8
        rows = []
        for field, ra, dec in _fields(region, spacing):
            for band in self.bands:
                random = rng(seed, "pointings", "rubin", field, band)
                mean = settings.visits[band] * spacing**2 / FIELD_AREA
                count = random.poisson(mean) if mean < 1 else int(round(mean))
                if not count:
                    continue
                night = np.sort(random.integers(0, 5 * 365, count))
                # uniform over the field's own cell, so that fields together cover the sky evenly
                xi, eta = random.uniform(-spacing / 2, spacing / 2, (2, count))
                centre_ra, centre_dec = from_tangent_plane(ra, dec, xi, eta)
                rows.append(
                    pd.DataFrame(
                        {
                            "band": band,
                            "mjd": settings.start + night + random.uniform(0.1, 0.4, count),
                            "exptime": 30.0,
                            "ra": centre_ra,
                            "dec": centre_dec,
                            "pa": random.uniform(0, 360, count),
                            "seeing": settings.seeing * np.exp(0.2 * random.standard_normal(count)),
                            "airmass": 1 / np.cos(np.radians(random.uniform(5, 45, count))),
                            "sky_brightness": SKY[band] + 0.3 * random.standard_normal(count),
                        }
                    )
                )
        visits = pd.concat(rows).sort_values(["mjd", "band"], ignore_index=True)
        return visits.assign(visit=np.arange(len(visits)))

    def footprints(self, visit: Exposure, ra: float, dec: float, radius: float) -> dict[int, np.ndarray]:
        """Return the corners of the 189 detectors of a visit, wherever the cone is: all at once they cost nothing."""
        half = np.array(self.shape[::-1]) * SCALE / 2
        x, y = (_CENTRES[:, None, :] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])).transpose(2, 0, 1) / 3600
        angle = np.radians(visit.pa)
        xi, eta = -x * np.cos(angle) + y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
        corners = np.stack(from_tangent_plane(visit.ra, visit.dec, xi, eta), axis=-1)
        return dict(enumerate(corners))

    def header(self, exposure: Exposure) -> dict:
        """Return the header of an exposure: gnomonic about the boresight, +y at the position angle `pa`."""
        return _header(exposure, exposure.detector, self.shape)

    def psf(self, exposure: Exposure, size: int) -> PsfBasis:
        """Return the PSF basis of an exposure: Kolmogorov atmosphere and Gaussian system, both with airmass^0.6."""
        return self.effective_psf([exposure], np.ones(1), size)

    def effective_psf(self, exposures: list[Exposure], weights: np.ndarray, size: int) -> PsfBasis:
        """Return the basis of the weighted mean PSF of some exposures of one band, on this instrument's pixels."""
        nodes = self.bandpass(exposures[0].band).nodes
        share = np.asarray(weights) / np.sum(weights)
        seeing = np.array([exposure.seeing for exposure in exposures])
        thickness = np.array([exposure.airmass for exposure in exposures]) ** 0.6
        frequency = np.linspace(0, 2.2 * np.pi * np.sqrt(2) / SCALE, 3000)
        transfers = []
        for wave in nodes:
            fwhm = seeing * (wave / 500) ** -0.3 * thickness
            transfers.append(
                share @ kolmogorov_transfer(frequency[None], fwhm[:, None], SYSTEM_FWHM * thickness[:, None])
            )
        return radial_basis(frequency, np.array(transfers), SCALE, size)

    def background(self, exposure: Exposure, header: dict, rows: slice = WHOLE, columns: slice = WHOLE) -> np.ndarray:
        """Return the expected electrons (ny, nx) of sky and dark current."""
        sky = self.bandpass(exposure.band).ab_photons() * 10 ** (-0.4 * exposure.sky_brightness)
        return ((pixel_areas(header, self.shape, rows, columns) * sky + DARK) * exposure.exptime).astype(np.float32)

    def sky_noise(self, exposure: Exposure, background: np.ndarray | float) -> float:
        """Return the noise of an empty pixel, electrons rms."""
        return float(np.sqrt(np.mean(background) + self.detector.read_noise**2))

    def pixel_noise(self, exposure: Exposure) -> float:
        """Return the noise of an empty pixel, electrons rms, without making the image of the background."""
        sky = self.bandpass(exposure.band).ab_photons() * 10 ** (-0.4 * exposure.sky_brightness)
        return self.sky_noise(exposure, (SCALE**2 * sky + DARK) * exposure.exptime)


def kolmogorov_transfer(frequency: np.ndarray, atmosphere: np.ndarray, system: np.ndarray) -> np.ndarray:
    """Return the transform, at radial frequencies in 1/arcsec (2 pi / period), of Kolmogorov seeing and a Gaussian.

    `atmosphere` and `system` are FWHM in arcsec. Kolmogorov's transform is exp(-3.4419 (k lambda / 2 pi r0)^(5/3)) with
    FWHM = 0.97586 lambda / r0 (Fried 1966; the constants are GalSim's).
    """
    kolmogorov = np.exp(-3.4418970 * (frequency * atmosphere / (2 * np.pi * 0.9758634299)) ** (5 / 3))
    return kolmogorov * np.exp(-((frequency * system / 2.3548200450309493) ** 2) / 2)


def detector_centres() -> np.ndarray:
    """Return the centres (189, 2) of the detectors on the focal plane, arcsec: 21 rafts of 3 x 3.

    Raft pitch 127 mm, detector pitch 42.25 mm (LSST Camera, LCA-280), 20 arcsec a millimetre.
    """
    centres = [
        (127.0 * rx + 42.25 * cx, 127.0 * ry + 42.25 * cy)
        for ry in range(-2, 3)
        for rx in range(-2, 3)
        if not (abs(rx) == 2 and abs(ry) == 2)
        for cy in range(-1, 2)
        for cx in range(-1, 2)
    ]
    return np.array(centres) * 20.0


_CENTRES = detector_centres()


def _header(exposure: Exposure, detector: int, shape: tuple[int, int]) -> dict:
    angle = np.radians(exposure.pa)
    x, y = _CENTRES[detector]
    step = SCALE / 3600
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": float(exposure.ra),
        "CRVAL2": float(exposure.dec),
        "CRPIX1": (shape[1] + 1) / 2 - x / SCALE,
        "CRPIX2": (shape[0] + 1) / 2 - y / SCALE,
        "CD1_1": -step * np.cos(angle),
        "CD1_2": step * np.sin(angle),
        "CD2_1": step * np.sin(angle),
        "CD2_2": step * np.cos(angle),
        "RADESYS": "ICRS",
    }


def _fields(region: Region, spacing: float) -> list[tuple[int, float, float]]:
    """Return the fields (id, ra, dec) of a fixed all-sky grid whose dithered visits may reach the region."""
    ra, dec = region.centre
    rings = int(np.ceil(180 / spacing))
    corner = unit_vectors([region.ra_min, region.ra_max], [region.dec_min, region.dec_max])
    reach = np.degrees(np.arccos(np.clip(corner @ unit_vectors(ra, dec), -1, 1).min())) + spacing + 1.8
    fields = []
    for ring in range(rings):
        ring_dec = -90 + (ring + 0.5) * 180 / rings
        columns = max(1, int(round(360 * np.cos(np.radians(ring_dec)) / spacing)))
        for column in range(columns):
            ring_ra = (column + 0.5) * 360 / columns
            if unit_vectors(ring_ra, ring_dec) @ unit_vectors(ra, dec) > np.cos(np.radians(min(reach, 180))):
                fields.append((ring * 10_000 + column, ring_ra, ring_dec))
    return fields
