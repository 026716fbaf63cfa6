"""Calibration files of Roman's detectors: one FITS file per SCA, with the layout of Troxel et al. (2023), table 1."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy


@dataclass(frozen=True)
class Extension:
    """Layout of an extension of the file."""

    name: str
    """Name of the extension."""
    dtype: str
    """NumPy dtype of the values; empty for the table SOURCES and for extensions without values."""
    shape: tuple[int, ...]
    """Shape of the values, in the order of NumPy."""
    text: str
    """Description."""


_WHOLE = (4096, 4096)
TABLE = (
    Extension("SOURCES", "", (), "where each extension is from"),
    Extension("RELQE1", "f4", _WHOLE, "relative quantum efficiency of pixels"),
    Extension("RELQE2", "f4", (50, 64, 64), "relative quantum efficiency by wavelength, 400-2400 nm, and block"),
    Extension("QYIELD", "f4", (50, 32, 32), "electrons a photon by wavelength and block"),
    Extension("CHRGDIFF", "f4", (3, 32, 32), "covariance (yy, xx, xy) of charge diffusion, pixels^2"),
    Extension("BFE", "f4", (5, 5, 32, 32), "brighter-fatter area kernel (dy, dx), 1/electron"),
    Extension("BFEFLAT", "f4", (160, 160), "the same, blocks side by side"),
    Extension("PERSIST", "f4", (6, *_WHOLE), "persistence by stimulus, electrons"),
    Extension("DARK", "f4", _WHOLE, "dark current, e/s"),
    Extension("CRNL", "f4", (1, *_WHOLE), "exponent of the count rate"),
    Extension("SATURATE", "i4", _WHOLE, "full well, electrons"),
    Extension("CNL", "f8", (3, *_WHOLE), "classical nonlinearity b2, b3, b4"),
    Extension("BURNIN", "", (), "not used"),
    Extension("IPC", "f4", (3, 3, 512, 512), "interpixel capacitance (dy, dx) of source pixels"),
    Extension("IPCFLAT", "f4", (1536, 1536), "the same, blocks side by side"),
    Extension("VTPE", "", (), "vertical trailing pixel effect: not valid"),
    Extension("BADPIX", "u4", _WHOLE, "bad pixel bits"),
    Extension("READ", "f8", (3, *_WHOLE), "reset noise and its scatter, DN; read noise of an exposure, e"),
    Extension("GAIN", "f4", (32, 32), "gain, e/DN"),
    Extension("BIAS", "u2", _WHOLE, "bias, DN"),
)
"""The extensions of table 1, in order."""
BY_NAME = {extension.name: extension for extension in TABLE}
"""The extensions by name."""
FLAT = {"BFEFLAT": "BFE", "IPCFLAT": "IPC"}
"""Extensions that hold the kernels of another extension side by side, and the name of the other extension."""
_BITPIX = {"f4": (-32, 0), "f8": (-64, 0), "i4": (32, 0), "u4": (32, 1 << 31), "u2": (16, 1 << 15)}
"""BITPIX and BZERO in FITS, by dtype."""


def path_of(folder: AnyPath, sca: int) -> AnyPath:
    """Return the path of the file of an SCA in a folder."""
    return folder / f"sca{sca:02d}.fits"


def flat(kernels: np.ndarray) -> np.ndarray:
    """Return kernels of shape (n, n, by, bx) side by side as an image of shape (n * by, n * bx)."""
    n, _, by, bx = kernels.shape
    return np.ascontiguousarray(kernels.transpose(2, 0, 3, 1)).reshape(n * by, n * bx)


def write(path: Path, sca: int, planes: Iterable[tuple[str, np.ndarray | Iterable[np.ndarray]]], source: str) -> None:
    """Write a calibration file, with one extension in memory at a time.

    Parameters
    ----------
    path : Path
        Path of the file; it is replaced once the new file is complete.
    sca : int
        Number of the SCA.
    planes : iterable of (str, ndarray or iterable of ndarray)
        Names and values, or planes of the first axis of the values, of the extensions with values, in the order of
        TABLE, without BFEFLAT and IPCFLAT, which follow from BFE and IPC.
    source : str
        Source of every extension, for the table SOURCES.

    Raises
    ------
    ValueError
        If a name, dtype or shape differs from TABLE.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    names = [extension.name for extension in TABLE if extension.dtype]
    columns = [
        fits.Column("EXTNAME", "16A", array=np.array(names)),
        fits.Column("SOURCE", "80A", array=np.array([source] * len(names))),
    ]
    remaining = iter(planes)
    kernels: dict[str, np.ndarray] = {}
    try:
        with fits.open(temporary, mode="append") as file:
            file.append(fits.PrimaryHDU(header=fits.Header([("DETECTOR", sca, "SCA, 1-18")])))
            for extension in TABLE:
                if extension.name == "SOURCES":
                    hdu: fits.ImageHDU | fits.BinTableHDU = fits.BinTableHDU.from_columns(columns, name="SOURCES")
                elif not extension.dtype:
                    hdu = fits.ImageHDU(name=extension.name)
                    hdu.header["VALID"] = (False, extension.text)
                elif extension.name in FLAT:
                    hdu = fits.ImageHDU(flat(kernels.pop(FLAT[extension.name])), name=extension.name)
                else:
                    name, made = next(remaining)
                    values = made if isinstance(made, np.ndarray) else np.stack(list(made))
                    if (name, values.shape, values.dtype) != (extension.name, extension.shape, extension.dtype):
                        raise ValueError(f"{name} {values.dtype} {values.shape}: expected {extension}")
                    if name in FLAT.values():
                        kernels[name] = values
                    hdu = fits.ImageHDU(values, name=name)
                hdu.header["COMMENT"] = extension.text
                hdu.add_checksum()
                file.append(hdu)
                file.flush()
                hdu.data = None if isinstance(hdu, fits.ImageHDU) else hdu.data
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check(path: AnyPath) -> None:
    """Check that a file has the extensions of TABLE, with their order, types and shapes, without reading values.

    Raises
    ------
    UserError
        If the file is not FITS, or an extension is missing, misplaced or of another type or shape. The message names
        the file and the extension, and says what was found and what is expected.
    """
    try:
        with fits.open(local_copy(path), lazy_load_hdus=False) as file:
            found = [hdu.name for hdu in file[1:]]
            missing = [extension.name for extension in TABLE if extension.name not in found]
            if missing:
                raise UserError(
                    f"{path}: extensions {', '.join(missing)} are missing (found {', '.join(found) or 'none'}): a "
                    "calibration file has those of table 1 of Troxel et al. (2023)"
                )
            expected = [extension.name for extension in TABLE]
            if found != expected:
                raise UserError(f"{path}: extensions are {', '.join(found)}, expected {', '.join(expected)}")
            for hdu, extension in zip(file[1:], TABLE, strict=True):
                if extension.dtype:
                    _check_values(path, hdu.header, extension)
    except OSError as error:
        raise UserError(f"{path}: not a FITS file that can be read ({error})") from None


def _check_values(path: AnyPath, header: fits.Header, extension: Extension) -> None:
    shape = tuple(header.get(f"NAXIS{k}", 0) for k in range(header.get("NAXIS", 0), 0, -1))
    if shape != extension.shape:
        raise UserError(f"{path}: {extension.name} has shape {shape}, expected {extension.shape}")
    bitpix, bzero = header["BITPIX"], int(header.get("BZERO", 0))
    if (bitpix, bzero) != _BITPIX[extension.dtype]:
        raise UserError(
            f"{path}: {extension.name} has BITPIX {bitpix} and BZERO {bzero}, expected "
            f"{_BITPIX[extension.dtype][0]} and {_BITPIX[extension.dtype][1]} ({extension.dtype})"
        )


def read(path: AnyPath, name: str) -> np.ndarray:
    """Return the values of an extension, in native byte order.

    Raises
    ------
    UserError
        If the extension cannot be read, its checksum does not match, or it has values that are not finite.
    """
    extension = BY_NAME[name]
    try:
        damaged = not _has_valid_checksum(path, name)
        with fits.open(local_copy(path), memmap=False) as file:
            hdu = file[name]
            _check_values(path, hdu.header, extension)
            values = hdu.data
    except (OSError, KeyError, TypeError) as error:
        raise UserError(f"{path}: {name} cannot be read ({error})") from None
    if damaged:
        raise UserError(f"{path}: {name} is damaged (its checksum does not match): fetch or make the file again")
    # in place: the largest extensions have 400 MB
    values = values if values.dtype.isnative else values.byteswap(inplace=True).view(values.dtype.newbyteorder("="))
    values = values.astype(extension.dtype, copy=False)
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).sum())
        raise UserError(f"{path}: {name} has {bad} values that are not finite: correct the file")
    return values


def _has_valid_checksum(path: AnyPath, name: str) -> bool:
    """Return whether the values of an extension have the checksum in its header; true for one without a checksum."""
    with fits.open(local_copy(path), memmap=True, do_not_scale_image_data=True) as file:
        datasum = file[name].header.get("DATASUM")
        return datasum is None or str(file[name]._calculate_datasum()) == datasum
