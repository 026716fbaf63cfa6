"""Roman's images in ASDF: `ImageModel` and `MosaicModel` of roman_datamodels, which validates what is written."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from astropy import coordinates, units
from astropy.modeling import CompoundModel, models
from astropy.time import Time

from romandask.model.errors import UserError

WORDS = {
    "saturated": "SATURATED",
    "no_data": "DO_NOT_USE",
    "disconnected": "DEAD",
    "hot": "HOT",
    "adjacent": "OTHER_BAD_PIXEL",
    "low_efficiency": "LOW_QE",
    "noisy": "TELEGRAPH",
    "persistence": "PERSISTENCE",
    "cosmic_ray": "JUMP_DET",
}
"""By our flag that of romancal."""


def available() -> None:
    """Raise a UserError where roman_datamodels or gwcs is not there."""
    missing = [name for name in ("roman_datamodels", "gwcs") if find_spec(name) is None]
    if missing:
        raise UserError(f"ASDF needs the package {missing[0]}: pip install 'romandask[asdf]'")


def write(
    path: Path,
    planes: dict[str, np.ndarray],
    flags: dict[str, int],
    header: dict[str, Any],
    exposure: dict[str, Any],
    photometry: tuple[float, float],
) -> None:
    """Write a calibrated exposure; what a simulation has not (guide stars, program, reference files) stays unset.

    Parameters
    ----------
    planes : data (electron/s), err and var_poisson (its square), dq (our flags)
    flags : our bits, by name
    header : WCS (TAN-SIP), FITS cards
    exposure : visit, detector, band, mjd, exptime, ra, dec, pa, optical_element
    photometry : MJy/sr of one electron/s, and the mean area of a pixel, sr

    Raises
    ------
    UserError
        If the packages are not there.
    """
    available()
    datamodels, dqflags = import_module("roman_datamodels.datamodels"), import_module("roman_datamodels.dqflags")
    model = datamodels.ImageModel.create_fake_data(shape=planes["data"].shape)
    model.data = planes["data"].astype(np.float32)
    model.err = planes["err"].astype(np.float16)
    model.var_poisson = planes["var_poisson"].astype(np.float16)
    dq = np.zeros(planes["dq"].shape, np.uint32)
    for name, bit in flags.items():
        word = int(dqflags.pixel[WORDS[name]])
        # persistence alone forbids no pixel
        dq[(planes["dq"] & bit) > 0] |= word if name == "persistence" else word | int(dqflags.pixel.DO_NOT_USE)
    model.dq = dq
    start = Time(exposure["mjd"], format="mjd", scale="utc").isot
    end = Time(exposure["mjd"] + exposure["exptime"] / 86400, format="mjd", scale="utc").isot
    meta, detector = model.meta, f"WFI{int(exposure['detector']):02d}"
    meta.filename, meta.product_type, meta.calibration_software_name = path.name, "l2", "romandask"
    meta.instrument.detector, meta.instrument.optical_element = detector, exposure["optical_element"]
    meta.exposure.start_time, meta.exposure.end_time = Time(start), Time(end)
    meta.exposure.exposure_time = meta.exposure.effective_exposure_time = float(exposure["exptime"])
    meta.observation.visit, meta.observation.observation_id = int(exposure["visit"]), str(exposure["visit"])
    meta.pointing.target_ra, meta.pointing.target_dec = float(exposure["ra"]), float(exposure["dec"])
    meta.pointing.pa_aperture = float(exposure["pa"])
    meta.wcsinfo.aperture_name = f"{detector}_FULL"
    meta.wcsinfo.ra_ref, meta.wcsinfo.dec_ref = float(header["CRVAL1"]), float(header["CRVAL2"])
    meta.photometry.conversion_megajanskys, meta.photometry.pixel_area = photometry
    meta.wcs = gwcs_of(header, planes["data"].shape)
    _save(model, path)


@dataclass(frozen=True)
class Mosaic:
    """What is told of a coadd."""

    survey: str
    """Name of the pipeline."""
    version: str
    """Of what made it."""
    tile: str
    optical_element: str
    scale: float
    """Arcsec a pixel."""
    native_scale: float
    """Of the exposures."""
    pixfrac: float
    members: tuple[str, ...]
    """Names of the exposures, in the order of the bits of `context`."""
    begin: float
    """MJD of the first."""
    end: float
    """MJD at which the last ended."""
    seconds: float
    """Exposure time of a pixel, mean over those that have any."""


def write_mosaic(path: Path, planes: dict[str, np.ndarray], header: dict[str, Any], about: Mosaic) -> None:
    """Write a coadd as a level 3 mosaic with the metadata of a community product, said to be simulated.

    Parameters
    ----------
    planes : data and err (MJy/sr), var_poisson and var_rnoise (their squares), weight, context (plane, y, x) of bits
    header : WCS (TAN), FITS cards

    Raises
    ------
    UserError
        If the packages are not there.
    """
    available()
    datamodels = import_module("roman_datamodels.datamodels")
    model = datamodels.MosaicModel.create_fake_data(shape=planes["data"].shape)
    for name, plane in planes.items():
        model[name] = plane
    meta, shape = model.meta, planes["data"].shape
    meta.filename, meta.product_type = path.name, "l3"
    meta.calibration_software_name, meta.calibration_software_version = "romandask", about.version
    meta.instrument.optical_element = about.optical_element
    times = {"first": about.begin, "last": about.end, "mean": (about.begin + about.end) / 2}
    for name, mjd in times.items():
        meta.coadd_info[f"time_{name}"] = Time(mjd, format="mjd", scale="utc")
    meta.coadd_info.exposure_time = about.seconds
    there = planes["weight"] > 0
    values = planes["data"][there] if there.any() else np.zeros(1, np.float32)
    meta.statistics.image_median = float(np.median(values))
    meta.statistics.image_rms = float(values.std(dtype=float))
    meta.statistics.good_pixel_fraction = float(there.mean())
    meta.association.name = about.survey
    meta.cal_step.flux = meta.cal_step.resample = "COMPLETE"
    meta.cal_step.outlier_detection = meta.cal_step.skymatch = "SKIPPED"
    meta.resample.pixfrac, meta.resample.pixel_scale_ratio = about.pixfrac, about.scale / about.native_scale
    meta.resample.pointings, meta.resample.members = len(about.members), list(about.members)
    meta.resample.weight_type = "exptime"
    info, centre = meta.wcsinfo, (float(header["CRVAL1"]), float(header["CRVAL2"]))
    info.ra, info.dec, info.ra_ref, info.dec_ref = *centre, *centre
    info.x_ref, info.y_ref = float(header["CRPIX1"]) - 1, float(header["CRPIX2"]) - 1
    info.pixel_scale = info.pixel_scale_ref = about.scale
    info.orientation = info.orientation_ref = 0.0
    info.rotation_matrix = [[-1.0, 0.0], [0.0, 1.0]]
    info.image_shape, info.skycell_name = list(shape), about.tile
    meta.wcs = gwcs_of(header, shape)
    corners = meta.wcs(*np.array([(0, 0), (0, shape[0] - 1), (shape[1] - 1, shape[0] - 1), (shape[1] - 1, 0)]).T)
    info.s_region = "POLYGON ICRS " + " ".join(f"{ra:.9f} {dec:.9f}" for ra, dec in zip(*corners, strict=True))
    # the schema of minimal metadata of community products; what an archive gives out stays unset
    meta["ccsp"] = {
        "name": "romandask",
        "file_version": about.version[:9],
        "target_name": "Simulated",
        "intent": "SCIENCE",
        "simulated_flag": True,
        "license": "BSD-3-Clause",
        "target_keywords": ["Galaxies", "Stars"],
    }
    _save(model, path)


def _save(model: Any, path: Path) -> None:
    """Write a file whole or not at all, and under its own name, which goes into it."""
    with TemporaryDirectory(dir=path.parent, prefix=".partial-") as folder:
        model.save(Path(folder) / path.name)
        os.replace(Path(folder) / path.name, path)


def gwcs_of(header: dict[str, Any], shape: tuple[int, ...]) -> Any:
    """Return the gwcs of a TAN or TAN-SIP header: pixels (from 0) to ICRS, degrees."""
    gwcs = import_module("gwcs")
    frames = import_module("gwcs.coordinate_frames")
    detector = frames.Frame2D(name="detector", axes_order=(0, 1), unit=(units.pix, units.pix))
    sky = frames.CelestialFrame(reference_frame=coordinates.ICRS(), name="world", unit=(units.deg, units.deg))
    found = gwcs.WCS([(detector, transform_of(header)), (sky, None)])
    found.bounding_box = ((-0.5, shape[1] - 0.5), (-0.5, shape[0] - 0.5))
    return found


def transform_of(header: dict[str, Any]) -> CompoundModel:
    """Return the transform of a TAN or TAN-SIP header: pixels (from 0) to right ascension, declination, degrees."""
    shift = models.Shift(1 - float(header["CRPIX1"])) & models.Shift(1 - float(header["CRPIX2"]))
    polynomials = []
    for axis, own in (("A", "c1_0"), ("B", "c0_1")):
        # without a distortion it is the identity
        order = int(header.get(f"{axis}_ORDER", 1))
        terms = {
            f"c{i}_{j}": float(header.get(f"{axis}_{i}_{j}", 0.0))
            for i in range(order + 1)
            for j in range(order + 1 - i)
        }
        # SIP adds to the pixel itself
        polynomials.append(models.Polynomial2D(order, **{**terms, own: terms[own] + 1}))
    matrix = [[float(header[f"CD{i}_{j}"]) for j in (1, 2)] for i in (1, 2)]
    pole = float(header.get("LONPOLE", 180.0))
    rotate = models.RotateNative2Celestial(float(header["CRVAL1"]), float(header["CRVAL2"]), pole)
    distort = models.Mapping((0, 1, 0, 1)) | polynomials[0] & polynomials[1]
    return shift | distort | models.AffineTransformation2D(matrix) | models.Pix2Sky_TAN() | rotate
