"""Images in FITS: PRIMARY, then one checksummed HDU a plane (SCI, ERR, DQ, ...), each with the whole WCS."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

Cards = dict[str, Any]
"""Header cards by keyword: a value, or a value and a comment."""


@dataclass(frozen=True)
class Plane:
    """One HDU."""

    name: str
    """EXTNAME."""
    make: Callable[[], np.ndarray]
    """Makes its array when it is written: a tile has more planes than would fit a worker."""
    unit: str = ""
    """BUNIT."""
    on_sky: bool = True
    """Whether its pixels are those of the WCS."""
    cards: tuple[tuple[str, Any], ...] = ()


def write(path: Path, primary: Cards, wcs: Cards, planes: Iterable[Plane]) -> None:
    """Write a file whole, or not at all; one plane is in memory at a time.

    Parameters
    ----------
    primary : cards of the PRIMARY HDU, which has no data
    wcs : cards of the WCS of every plane that is on the sky
    """
    temporary = path.with_name(f".{path.name}.partial")
    first = fits.PrimaryHDU()
    first.header.update(primary)
    first.writeto(temporary, overwrite=True, checksum=True)
    for plane in planes:
        header = fits.Header()
        if plane.on_sky:
            header.update(wcs)
        if plane.unit:
            header["BUNIT"] = plane.unit
        header.update(dict(plane.cards))
        hdu = fits.ImageHDU(plane.make(), header, name=plane.name)
        with fits.open(temporary, mode="append", memmap=False) as hdus:
            hdus.append(hdu)
            hdu.add_checksum()
        del hdu
    os.replace(temporary, path)
