"""Writer of Roman's data models in ASDF: `ImageModel` and `MosaicModel` of roman_datamodels, which validates them."""

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

from romandask.instruments.exposure import Exposure
from romandask.model.errors import UserError

FLAG_NAMES = {
    "saturated": "SATURATED",
    "no_data": "DO_NOT_USE",
    "not_drawn": "DO_NOT_USE",
    "disconnected": "DEAD",
    "hot": "HOT",
    "adjacent": "OTHER_BAD_PIXEL",
    "low_efficiency": "LOW_QE",
    "noisy": "TELEGRAPH",
    "persistence": "PERSISTENCE",
    "cosmic_ray": "JUMP_DET",
}
"""Name of the flag in romancal, by the name of the flag in `dq`."""


def check_packages() -> None:
    """Check that roman_datamodels and gwcs are installed.

    Raises
    ------
    UserError
        If one of them is not.
    """
    missing = [name for name in ("roman_datamodels", "gwcs") if find_spec(name) is None]
    if missing:
        raise UserError(f"ASDF needs the package {missing[0]}: pip install 'romandask[asdf]'")


def write_exposure(
    path: Path,
    planes: dict[str, np.ndarray],
    *,
    flags: dict[str, int],
    header: dict[str, Any],
    exposure: Exposure,
    optical_element: str,
    conversion: float,
    pixel_area: float,
) -> None:
    """Write a calibrated exposure as a level 2 image.

    Metadata that a simulation does not have (guide stars, program, reference files) stay unset.

    Parameters
    ----------
    path : Path
        ASDF file. It appears under its name when it is complete.
    planes : dict of str to ndarray, shape (ny, nx)
        data (electron/s, with the sky), err (electron/s), var_poisson (electron^2/s^2), and dq (flags of `flags`).
    flags : dict of str to int
        Bit masks of dq, by the name of the flag.
    header : dict
        FITS cards of the WCS (TAN-SIP).
    exposure : Exposure
        Detector, time and pointing.
    optical_element : str
        Name of the band in the data models.
    conversion : float, MJy/sr
        Surface brightness of one electron/s in a pixel.
    pixel_area : float, sr
        Mean area of a pixel.

    Raises
    ------
    UserError
        If the packages are not installed.
    """
    check_packages()
    datamodels, dqflags = import_module("roman_datamodels.datamodels"), import_module("roman_datamodels.dqflags")
    model = datamodels.ImageModel.create_fake_data(shape=planes["data"].shape)
    model.data = planes["data"].astype(np.float32)
    model.err = planes["err"].astype(np.float16)
    model.var_poisson = planes["var_poisson"].astype(np.float16)
    dq = np.zeros(planes["dq"].shape, np.uint32)
    for name, mask in flags.items():
        flag = int(dqflags.pixel[FLAG_NAMES[name]])
        # a pixel with persistence alone may be used
        dq[(planes["dq"] & mask) > 0] |= flag if name == "persistence" else flag | int(dqflags.pixel.DO_NOT_USE)
    model.dq = dq
    start = Time(exposure.mjd, format="mjd", scale="utc").isot
    end = Time(exposure.mjd + exposure.exptime / 86400, format="mjd", scale="utc").isot
    meta, detector = model.meta, f"WFI{int(exposure.detector):02d}"
    meta.filename, meta.product_type, meta.calibration_software_name = path.name, "l2", "romandask"
    meta.instrument.detector, meta.instrument.optical_element = detector, optical_element
    meta.exposure.start_time, meta.exposure.end_time = Time(start), Time(end)
    meta.exposure.exposure_time = meta.exposure.effective_exposure_time = float(exposure.exptime)
    meta.observation.visit, meta.observation.observation_id = int(exposure.visit), str(exposure.visit)
    meta.pointing.target_ra, meta.pointing.target_dec = float(exposure.ra), float(exposure.dec)
    meta.pointing.pa_aperture = float(exposure.pa)
    meta.wcsinfo.aperture_name = f"{detector}_FULL"
    meta.wcsinfo.ra_ref, meta.wcsinfo.dec_ref = float(header["CRVAL1"]), float(header["CRVAL2"])
    meta.photometry.conversion_megajanskys, meta.photometry.pixel_area = conversion, pixel_area
    meta.wcs = gwcs_of(header, planes["data"].shape)
    _save(model, path)


@dataclass(frozen=True, kw_only=True)
class MosaicMetadata:
    """Metadata of a mosaic."""

    survey: str
    """Name of the pipeline."""
    version: str
    """Version of the software that made the coadd."""
    tile: str
    """Name of the tile."""
    optical_element: str
    """Name of the band in the data models."""
    pixel_scale: float
    """Pixel scale of the mosaic, arcsec."""
    native_scale: float
    """Pixel scale of the exposures, arcsec."""
    pixfrac: float
    """Linear size of drizzled pixels, as a fraction of the native pixel."""
    members: tuple[str, ...]
    """Names of the exposures, in the order of the bits of `context`."""
    begin: float
    """Start of the first exposure, MJD."""
    end: float
    """End of the last exposure, MJD."""
    exposure_time: float
    """Exposure time of a pixel, s: mean over the pixels that have any."""


def write_mosaic(path: Path, planes: dict[str, np.ndarray], header: dict[str, Any], metadata: MosaicMetadata) -> None:
    """Write a coadd as a level 3 mosaic, with the metadata of a community product that is marked as simulated.

    Parameters
    ----------
    path : Path
        ASDF file. It appears under its name when it is complete.
    planes : dict of str to ndarray, shape (ny, nx)
        data and err (MJy/sr), var_poisson and var_rnoise (MJy^2/sr^2), weight, and context, shape (n, ny, nx): bits.
    header : dict
        FITS cards of the WCS (TAN).
    metadata : MosaicMetadata
        Metadata.

    Raises
    ------
    UserError
        If the packages are not installed.
    """
    check_packages()
    datamodels = import_module("roman_datamodels.datamodels")
    model = datamodels.MosaicModel.create_fake_data(shape=planes["data"].shape)
    for name, plane in planes.items():
        model[name] = plane
    meta, shape = model.meta, planes["data"].shape
    meta.filename, meta.product_type = path.name, "l3"
    meta.calibration_software_name, meta.calibration_software_version = "romandask", metadata.version
    meta.instrument.optical_element = metadata.optical_element
    times = {"first": metadata.begin, "last": metadata.end, "mean": (metadata.begin + metadata.end) / 2}
    for name, mjd in times.items():
        meta.coadd_info[f"time_{name}"] = Time(mjd, format="mjd", scale="utc")
    meta.coadd_info.exposure_time = metadata.exposure_time
    covered = planes["weight"] > 0
    values = planes["data"][covered] if covered.any() else np.zeros(1, np.float32)
    meta.statistics.image_median = float(np.median(values))
    meta.statistics.image_rms = float(values.std(dtype=float))
    meta.statistics.good_pixel_fraction = float(covered.mean())
    meta.association.name = metadata.survey
    meta.cal_step.flux = meta.cal_step.resample = "COMPLETE"
    meta.cal_step.outlier_detection = meta.cal_step.skymatch = "SKIPPED"
    meta.resample.pixfrac = metadata.pixfrac
    meta.resample.pixel_scale_ratio = metadata.pixel_scale / metadata.native_scale
    meta.resample.pointings, meta.resample.members = len(metadata.members), list(metadata.members)
    meta.resample.weight_type = "exptime"
    info, centre = meta.wcsinfo, (float(header["CRVAL1"]), float(header["CRVAL2"]))
    info.ra, info.dec, info.ra_ref, info.dec_ref = *centre, *centre
    info.x_ref, info.y_ref = float(header["CRPIX1"]) - 1, float(header["CRPIX2"]) - 1
    info.pixel_scale = info.pixel_scale_ref = metadata.pixel_scale
    info.orientation = info.orientation_ref = 0.0
    info.rotation_matrix = [[-1.0, 0.0], [0.0, 1.0]]
    info.image_shape, info.skycell_name = list(shape), metadata.tile
    meta.wcs = gwcs_of(header, shape)
    corners = meta.wcs(*np.array([(0, 0), (0, shape[0] - 1), (shape[1] - 1, shape[0] - 1), (shape[1] - 1, 0)]).T)
    info.s_region = "POLYGON ICRS " + " ".join(f"{ra:.9f} {dec:.9f}" for ra, dec in zip(*corners, strict=True))
    # schema ccsp_minimal of community products; identifiers that an archive assigns stay unset
    meta["ccsp"] = {
        "name": "romandask",
        "file_version": metadata.version[:9],
        "target_name": "Simulated",
        "intent": "SCIENCE",
        "simulated_flag": True,
        "license": "BSD-3-Clause",
        "target_keywords": ["Galaxies", "Stars"],
    }
    _save(model, path)


def _save(model: Any, path: Path) -> None:
    """Write a model as ASDF; the file appears when it is complete."""
    # the name of the file is part of its content, so a temporary folder is used in place of a temporary name
    with TemporaryDirectory(dir=path.parent, prefix=".partial-") as folder:
        model.save(Path(folder) / path.name)
        os.replace(Path(folder) / path.name, path)


def gwcs_of(header: dict[str, Any], shape: tuple[int, ...]) -> Any:
    """Return the generalised WCS (gwcs) of a FITS header.

    Parameters
    ----------
    header : dict
        FITS cards of a TAN or TAN-SIP WCS.
    shape : tuple of int
        Shape (ny, nx) of the image, for the bounding box.

    Returns
    -------
    gwcs.WCS
        Pixel coordinates x, y (0 at the centre of the first pixel) to ICRS right ascension and declination, degrees.
    """
    gwcs = import_module("gwcs")
    frames = import_module("gwcs.coordinate_frames")
    detector = frames.Frame2D(name="detector", axes_order=(0, 1), unit=(units.pix, units.pix))
    sky = frames.CelestialFrame(reference_frame=coordinates.ICRS(), name="world", unit=(units.deg, units.deg))
    wcs = gwcs.WCS([(detector, transform_of(header)), (sky, None)])
    wcs.bounding_box = ((-0.5, shape[1] - 0.5), (-0.5, shape[0] - 0.5))
    return wcs


def transform_of(header: dict[str, Any]) -> CompoundModel:
    """Return the astropy model of the WCS of a FITS header.

    Parameters
    ----------
    header : dict
        FITS cards of a TAN or TAN-SIP WCS.

    Returns
    -------
    CompoundModel
        Pixel coordinates x, y (0 at the centre of the first pixel) to right ascension and declination, degrees.
    """
    shift = models.Shift(1 - float(header["CRPIX1"])) & models.Shift(1 - float(header["CRPIX2"]))
    polynomials = []
    for axis, linear_term in (("A", "c1_0"), ("B", "c0_1")):
        # without SIP cards the polynomial is the identity
        order = int(header.get(f"{axis}_ORDER", 1))
        terms = {
            f"c{i}_{j}": float(header.get(f"{axis}_{i}_{j}", 0.0))
            for i in range(order + 1)
            for j in range(order + 1 - i)
        }
        # SIP polynomials are added to the pixel coordinate
        polynomials.append(models.Polynomial2D(order, **{**terms, linear_term: terms[linear_term] + 1}))
    matrix = [[float(header[f"CD{i}_{j}"]) for j in (1, 2)] for i in (1, 2)]
    pole = float(header.get("LONPOLE", 180.0))
    rotate = models.RotateNative2Celestial(float(header["CRVAL1"]), float(header["CRVAL2"]), pole)
    distort = models.Mapping((0, 1, 0, 1)) | polynomials[0] & polynomials[1]
    return shift | distort | models.AffineTransformation2D(matrix) | models.Pix2Sky_TAN() | rotate
