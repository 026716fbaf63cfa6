"""Calibrations of Roman's detectors: files made from a seed, or files that are there, checked."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from romandask.formats.calibration import check, path_of, write
from romandask.instruments.roman_focal_plane import SCAS
from romandask.kernels.synthetic_sca import planes
from romandask.model.errors import UserError
from romandask.model.seeds import rng

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
        write(path, sca, planes(lambda name, sca=sca: rng(seed, "calibration", sca, name)), f"made up, seed {seed}")
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
