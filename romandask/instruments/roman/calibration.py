"""Calibrations of Roman's detectors: making and checking of files, and the product from which workers read rows."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Sequence
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
"""Size of one calibration file, bytes."""


def make_files(folder: Path, seed: int, scas: Sequence[int] = SCAS) -> Iterator[Path]:
    """Write calibration files of synthetic SCAs, one at a time, and yield their paths.

    The file of an SCA depends only on the seed and the SCA.

    Parameters
    ----------
    folder : Path
        Folder of the files; made if it does not exist.
    seed : int
        Seed of the synthetic calibrations.
    scas : sequence of int
        Numbers of the SCAs, 1 to 18.

    Raises
    ------
    UserError
        If an SCA does not exist, or the folder cannot be written or has too little free space.
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
    """Return the paths of the calibration files in a folder, after a check of their layout.

    Raises
    ------
    UserError
        If there is no calibration file, or a file has another layout than that of `calibration_files`.
    """
    paths = [path for sca in SCAS if (path := path_of(folder, sca)).is_file()]
    if not paths:
        raise UserError(f"{folder}: no calibration file ({path_of(folder, 1).name} to {path_of(folder, 18).name})")
    for path in paths:
        check(path)
    return paths


_YX, _GRID = ("y", "x"), (4096, 4096)


def _variable(name: str, dtype: str, shape: tuple[int, ...], axes: tuple[str, ...], unit: str, text: str) -> Variable:
    # not compressed: pixel-to-pixel noise compresses by a tenth only, and every exposure reads it in blocks of rows
    return Variable(name, dtype, shape, axes, {"units": unit, "long_name": text}, compress=False)


# axes over blocks of 64, 128 and 8 pixels a side
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
"""Calibrations of table 1 that exposures use, with small dtypes because all workers read them.

READ has only its last plane, BADPIX only the bits with a meaning. float16 (11 bits of precision) is used for quantities
that are known, or matter, to no better than one per cent.
"""


def unit_name(sca: int) -> str:
    """Return the name of the unit of an SCA, for example sca07."""
    return f"sca{sca:02d}"


def calibrations(source: CalibrationSource, scas: Sequence[int]) -> ImageProduct:
    """Return the lazy calibrations of some SCAs: dimensions (sca, ...), one variable for each of `VARIABLES`.

    All workers read the stored product a few rows at a time; it is uncompressed and has checksums.

    Parameters
    ----------
    source : CalibrationSource
        Files, or seed of synthetic calibrations.
    scas : sequence of int
        Numbers of the SCAs.

    Raises
    ------
    UserError
        If a file is missing or has another layout than that of `calibration_files`.
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
        # the largest values, in the dtype of a file and in that of the store, and a mask of them
        bytes_per_unit=750 << 20,
        seconds_per_unit=15.0,
        stream=maker.stream,
    )


@dataclass(frozen=True)
class MakeCalibration:
    """Makes the units of the calibrations: reads a file, or draws synthetic calibrations."""

    source: CalibrationSource
    """Files, or seed of synthetic calibrations."""
    scas: tuple[int, ...]
    """Number of the SCA of each unit."""

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Return the arrays of a unit by name."""
        return dict(self.stream(index))

    def stream(self, index: int) -> Iterator[tuple[str, np.ndarray]]:
        """Yield name and values of the arrays of a unit, one at a time."""
        variables = {variable.name: variable for variable in VARIABLES}
        for name, values in self.source.planes(self.scas[index]):
            if name in variables:
                if name == "READ":
                    # the read noise of an exposure; planes 0 and 1 are the reset noise and its scatter
                    values = tuple(values)[2]
                yield name, _stored(values, variables[name])
            # before the next values are made
            del values


def _stored(values: Iterable[np.ndarray], variable: Variable) -> np.ndarray:
    """Return values in shape and dtype of the store, converted one index of the first axis at a time to save memory.

    Bits of BADPIX without a meaning are dropped, and values above the largest float16 are set to it.
    """
    stored = np.empty(variable.shape, variable.dtype)
    for k, part in enumerate(values):
        if variable.dtype == "uint8":
            part = part & 255
        elif variable.dtype == "float16":
            part = np.minimum(part, 65504)
        stored[k] = part
    return stored
