"""Roman's level 2 images in ASDF: `ImageModel` of roman_datamodels, which validates what is written."""

from __future__ import annotations

import os
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

ELEMENTS = {"Y106": "F106", "J129": "F129", "H158": "F158", "F184": "F184"}
"""By band the name of the optical element."""
WORDS = {
    "saturated": "SATURATED", "no_data": "DO_NOT_USE", "disconnected": "DEAD", "hot": "HOT",
    "adjacent": "OTHER_BAD_PIXEL", "low_efficiency": "LOW_QE", "noisy": "TELEGRAPH",
    "persistence": "PERSISTENCE", "cosmic_ray": "JUMP_DET",
}  # fmt: skip
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
    exposure : visit, detector, band, mjd, exptime, ra, dec, pa
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
    meta.instrument.detector, meta.instrument.optical_element = detector, ELEMENTS[exposure["band"]]
    meta.exposure.start_time, meta.exposure.end_time = Time(start), Time(end)
    meta.exposure.exposure_time = meta.exposure.effective_exposure_time = float(exposure["exptime"])
    meta.observation.visit, meta.observation.observation_id = int(exposure["visit"]), str(exposure["visit"])
    meta.pointing.target_ra, meta.pointing.target_dec = float(exposure["ra"]), float(exposure["dec"])
    meta.pointing.pa_aperture = float(exposure["pa"])
    meta.wcsinfo.aperture_name = f"{detector}_FULL"
    meta.wcsinfo.ra_ref, meta.wcsinfo.dec_ref = float(header["CRVAL1"]), float(header["CRVAL2"])
    meta.photometry.conversion_megajanskys, meta.photometry.pixel_area = photometry
    meta.wcs = gwcs_of(header, planes["data"].shape)
    # whole or not at all, and under its own name, which goes into the file
    with TemporaryDirectory(dir=path.parent, prefix=".partial-") as folder:
        model.save(Path(folder) / path.name)
        os.replace(Path(folder) / path.name, path)


def gwcs_of(header: dict[str, Any], shape: tuple[int, ...]) -> Any:
    """Return the gwcs of a TAN-SIP header: pixels (from 0) to ICRS, degrees."""
    gwcs = import_module("gwcs")
    frames = import_module("gwcs.coordinate_frames")
    detector = frames.Frame2D(name="detector", axes_order=(0, 1), unit=(units.pix, units.pix))
    sky = frames.CelestialFrame(reference_frame=coordinates.ICRS(), name="world", unit=(units.deg, units.deg))
    found = gwcs.WCS([(detector, transform_of(header)), (sky, None)])
    found.bounding_box = ((-0.5, shape[1] - 0.5), (-0.5, shape[0] - 0.5))
    return found


def transform_of(header: dict[str, Any]) -> CompoundModel:
    """Return the transform of a TAN-SIP header from pixels (from 0) to right ascension and declination, degrees."""
    shift = models.Shift(1 - float(header["CRPIX1"])) & models.Shift(1 - float(header["CRPIX2"]))
    polynomials = []
    for axis, own in (("A", "c1_0"), ("B", "c0_1")):
        order = int(header[f"{axis}_ORDER"])
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
