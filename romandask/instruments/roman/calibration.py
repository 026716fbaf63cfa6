"""Calibrations of Roman's detectors: files made from a seed or checked, and the stage from which workers read rows."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from romandask.instruments.roman.calibration_files import check, path_of, write
from romandask.instruments.roman.calibration_source import CalibrationSource
from romandask.instruments.roman.focal_plane import SCAS
from romandask.kernels.detectors.sca import STIMULI
from romandask.kernels.detectors.synthetic_sca import WAVES
from romandask.model.errors import UserError
from romandask.products.images import Coordinates, ImageProduct
from romandask.products.units import Unit
from romandask.storage.arrays import Variable

BYTES = 1_600_000_000
"""Of one file."""


def make_files(folder: Path, seed: int, scas: Sequence[int] = SCAS) -> Iterator[Path]:
    """Write calibration files of made-up SCAs and yield where each is; the same from the same seed, in any order.

    Raises
    ------
    UserError
        If there is no such SCA, or the folder cannot be written or has no room.
    """
    for sca in scas:
        if sca not in SCAS:
            raise UserError(f"SCA {sca}: Roman has {SCAS[0]} to {SCAS[-1]}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror})") from None
    if free < BYTES * len(scas):
        raise UserError(
            f"{folder}: {len(scas)} files need {BYTES * len(scas) / 1e9:.1f} GB, {free / 1e9:.1f} GB are free: choose "
            "another folder, or fewer SCAs"
        )
    for sca in scas:
        path = path_of(folder, sca)
        write(path, sca, CalibrationSource(None, seed).planes(sca), f"made up, seed {seed}")
        yield path


def check_files(folder: Path) -> list[Path]:
    """Return the calibration files of a folder, each as it should be.

    Raises
    ------
    UserError
        If there are none, or one is not laid out as it should be.
    """
    found = [path for sca in SCAS if (path := path_of(folder, sca)).is_file()]
    if not found:
        raise UserError(f"{folder}: no calibration file ({path_of(folder, 1).name} to {path_of(folder, 18).name})")
    for path in found:
        check(path)
    return found


_YX, _GRID = ("y", "x"), (4096, 4096)


def _variable(name: str, dtype: str, shape: tuple[int, ...], axes: tuple[str, ...], unit: str, text: str) -> Variable:
    # noise from pixel to pixel, which compresses by a tenth, and is read a block of rows at a time by every exposure
    return Variable(name, dtype, shape, axes, {"units": unit, "long_name": text}, compress=False)


_OF_64, _OF_128, _OF_8 = (("by", "bx"), ("cy", "cx"), ("ay", "ax"))
VARIABLES = (
    _variable("RELQE1", "float32", _GRID, _YX, "1", "relative quantum efficiency of pixels"),
    _variable("RELQE2", "float32", (50, 64, 64), ("wave", *_OF_64), "1", "the same by wavelength, 64-pixel blocks"),
    _variable("QYIELD", "float32", (50, 32, 32), ("wave", *_OF_128), "electron", "a photon, 128-pixel blocks"),
    _variable("BFE", "float32", (5, 5, 32, 32), ("dy5", "dx5", *_OF_128), "1/electron", "brighter-fatter area kernel"),
    _variable("PERSIST", "float16", (6, *_GRID), ("stimulus", *_YX), "electron", "persistence f(Q)"),
    _variable("DARK", "float16", _GRID, _YX, "electron/s", "dark current"),
    _variable("CRNL", "float16", (1, *_GRID), ("order", *_YX), "1", "exponent of the count rate"),
    _variable("SATURATE", "int32", _GRID, _YX, "electron", "full well"),
    _variable("CNL", "float32", (3, *_GRID), ("power", *_YX), "", "classical nonlinearity b2, b3, b4, 1/electron^k"),
    _variable("IPC", "float32", (3, 3, 512, 512), ("dy3", "dx3", *_OF_8), "1", "interpixel capacitance, 8-pixel"),
    _variable("BADPIX", "uint8", _GRID, _YX, "", "bad pixel bits"),
    _variable("READ", "float16", _GRID, _YX, "electron", "read noise of an exposure, rms"),
    _variable("GAIN", "float32", (32, 32), _OF_128, "electron/DN", "gain, 128-pixel blocks"),
    _variable("BIAS", "uint16", _GRID, _YX, "DN", "bias"),
)
"""What exposures need of table 1, in fewer bytes, for all workers read it: of READ the last plane, of BADPIX the bits
that are known; float16 (11 bits) where what it describes is itself known, or acts, no better than to a per cent."""


def unit_name(sca: int) -> str:
    """Return the name of the unit of an SCA."""
    return f"sca{sca:02d}"


def calibrations(source: CalibrationSource, scas: Sequence[int]) -> ImageProduct:
    """Return the lazy calibrations of some SCAs: dims (sca, ...), one variable an extension of the paper's table 1.

    Stored, it is what all workers read: uncompressed, with checksums, a few rows at a time.

    Raises
    ------
    UserError
        If a file is missing, or not laid out as it should be.
    """
    source.check(scas)
    units = tuple(Unit(unit_name(sca), {"sca": sca, "source": source.state(sca)}) for sca in scas)

    def coordinates() -> Coordinates:
        return {
            "sca": (("sca",), np.array(scas, int), {}),
            "wave": (("wave",), WAVES, {"units": "nm"}),
            "stimulus": (("stimulus",), STIMULI, {"units": "electron"}),
        }

    maker = MakeCalibration(source, tuple(scas))
    return ImageProduct(
        stage="calibration/roman",
        units=units,
        make=maker,
        variables=VARIABLES,
        axes=("sca",),
        lengths=(len(scas),),
        coordinates=coordinates,
        # the largest plane as it is made or read, and as it is stored
        bytes_per_unit=1300 << 20,
        seconds_per_unit=15.0,
        stream=maker.stream,
    )


@dataclass(frozen=True)
class MakeCalibration:
    """Reads, or makes up, the calibrations of one SCA."""

    source: CalibrationSource
    scas: tuple[int, ...]

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return the planes of an SCA by name."""
        return dict(self.stream(index))

    def stream(self, index: int) -> Iterator[tuple[str, np.ndarray]]:
        """Yield the planes of an SCA, one after another."""
        kinds = {variable.name: variable.dtype for variable in VARIABLES}
        for name, values in self.source.planes(self.scas[index]):
            if name in kinds:
                values = values[2] if name == "READ" else values
                # of bits that nobody asks for none is kept, and float16 ends at 65504
                values = values & 255 if name == "BADPIX" else values
                values = np.minimum(values, 65504) if kinds[name] == "float16" else values
                yield name, values.astype(kinds[name], copy=False)
