"""Source of the calibrations of Roman's SCAs: a folder of files, or synthetic calibrations drawn from a seed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from romandask.instruments.roman.calibration_files import TABLE, check, path_of, read
from romandask.kernels.detectors.synthetic_sca import charge_diffusion, planes
from romandask.model.errors import UserError
from romandask.model.seeds import rng
from romandask.storage.paths import AnyPath, file_state


@dataclass(frozen=True)
class CalibrationSource:
    """Source of the calibrations of all SCAs."""

    folder: AnyPath | None
    """Folder of the files sca01.fits to sca18.fits; None for synthetic calibrations."""
    seed: int
    """Seed of the synthetic calibrations."""

    def check(self, scas: Iterable[int]) -> None:
        """Check that the files of some SCAs exist and have the layout of `calibration_files`, without reading values.

        Raises
        ------
        UserError
            If the folder or a file is missing, or a file has another layout. The message says what was found and what
            to do.
        """
        if self.folder is None:
            return
        if not self.folder.is_dir():
            raise UserError(
                f"roman.calibration: {self.folder} is no folder: name that of the SCAs' calibration files, or leave "
                "the setting out for made-up ones"
            )
        missing = [path_of(self.folder, sca).name for sca in scas if not path_of(self.folder, sca).is_file()]
        if missing:
            raise UserError(
                f"roman.calibration: {self.folder} has no {', '.join(missing)}: add them, or make them up with "
                "romandask calibration make"
            )
        for sca in scas:
            check(path_of(self.folder, sca))

    def planes(self, sca: int) -> Iterator[tuple[str, np.ndarray | Iterator[np.ndarray]]]:
        """Yield names and values of the calibrations of an SCA, in the order of table 1 of Troxel et al. (2023).

        Values are arrays, or iterators over the planes of their first axis.
        """
        if self.folder is None:
            yield from planes(partial(rng, self.seed, "calibration", sca))
            return
        for extension in TABLE:
            if extension.dtype and not extension.name.endswith("FLAT"):
                yield extension.name, read(path_of(self.folder, sca), extension.name)

    def diffusion(self, sca: int) -> float:
        """Return sigma of the charge diffusion, pixels, from the covariance (CHRGDIFF) averaged over an SCA."""
        return _diffusion(self, sca)

    def state(self, sca: int) -> Any:
        """Return a value that identifies the calibrations of an SCA, for the input hash, without reading them.

        It is the seed, or the path and the state (size, time) of the file.
        """
        if self.folder is None:
            return self.seed
        path = path_of(self.folder, sca)
        if not path.is_file():
            return str(path)
        return (str(path), *file_state(path))


@lru_cache(maxsize=18)
def _diffusion(source: CalibrationSource, sca: int) -> float:
    if source.folder is None:
        covariance = charge_diffusion(partial(rng, source.seed, "calibration", sca))
    else:
        covariance = read(path_of(source.folder, sca), "CHRGDIFF")
    return float(np.sqrt(covariance[:2].mean()))
