"""Where the calibrations of Roman's SCAs come from: a folder of files, or made-up SCAs of a seed."""

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
    """The calibrations of all SCAs."""

    folder: AnyPath | None
    """Of files sca01.fits to sca18.fits; None for made-up SCAs."""
    seed: int
    """Of those."""

    def check(self, scas: Iterable[int]) -> None:
        """Check that there is a file for every one of some SCAs, laid out as it should be; read no values.

        Raises
        ------
        UserError
            That names the folder or file, what was found and what to do.
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

    def planes(self, sca: int) -> Iterator[tuple[str, np.ndarray]]:
        """Yield names and values of the calibrations of an SCA, in the order of the paper's table 1."""
        if self.folder is None:
            yield from planes(partial(rng, self.seed, "calibration", sca))
            return
        for extension in TABLE:
            if extension.dtype and not extension.name.endswith("FLAT"):
                yield extension.name, read(path_of(self.folder, sca), extension.name)

    def diffusion(self, sca: int) -> float:
        """Return sigma, pixels, of the diffusion of charge: that of the mean covariance of an SCA (CHRGDIFF)."""
        return _diffusion(self, sca)

    def state(self, sca: int) -> Any:
        """Return what identifies the calibrations of an SCA, without reading them."""
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
