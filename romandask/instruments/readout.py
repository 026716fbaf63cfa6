"""Protocols of a detector's readout and of the light that it reads out.

`Light` is an exposure before the detector: the objects as a scene, and the background. A `Readout` adds the noise and
the detector effects and returns the arrays that are stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import galsim
import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.instruments.exposure import Exposure
from romandask.kernels.rendering.galsim_engine import Cell
from romandask.kernels.rendering.stamps import Scene
from romandask.storage.arrays import Variable


class Light(Protocol):
    """The light of one exposure, before the detector."""

    @property
    def exposure(self) -> Exposure:
        """The exposure."""

    @property
    def background(self) -> np.ndarray:
        """Expected electrons that do not come from objects, shape (ny, nx); see `Instrument.background`.

        They are 0 outside `window`.
        """

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the detector that are drawn; all of them for a readout that does not draw parts."""

    @property
    def scene(self) -> Scene:
        """The n objects, with positions in pixels and fluxes in electrons."""

    @property
    def stamp_sizes(self) -> np.ndarray:
        """Side of the stamp of each object, pixels, shape (n,); 0 for an object that is not drawn."""

    def expected(self, chosen: np.ndarray | None = None) -> np.ndarray:
        """Return the noiseless image of the objects.

        Parameters
        ----------
        chosen : ndarray of bool, shape (n,), optional
            True for the objects to draw; by default all objects are drawn.

        Returns
        -------
        ndarray, shape (ny, nx), electrons
        """

    def profiles(self, x: float, y: float) -> tuple[Cell, list[galsim.GSObject]]:
        """Return the PSF at a position as GalSim profiles, on a coarse grid of cells.

        Parameters
        ----------
        x, y : float, pixels
            Position on the detector, 0 at the centre of the first pixel.

        Returns
        -------
        cell : Cell
            The cell that contains the position; all positions in a cell have the same profiles.
        profiles : list of galsim.GSObject
            PSF of the cell at each node of the bandpass; see `Instrument.profiles`.
        """


class Readout(Protocol):
    """A detector: turns light into the arrays and tables of an exposure."""

    @property
    def variables(self) -> tuple[Variable, ...]:
        """Arrays of an exposure, `image` first; without `truth`, the noiseless image, which every exposure has."""

    @property
    def tables(self) -> dict[str, pa.Schema]:
        """Schemas, by name, of the tables stored with an exposure; at most one, the result of `leave`."""

    @property
    def draws_parts(self) -> bool:
        """True if a part of a detector can be read out without the rest: no effect spreads over the detector."""

    @property
    def seconds_per_pixel(self) -> float:
        """Time per pixel for sky, noise, detector and storage, seconds on one core of a laptop (measured)."""

    @property
    def settings(self) -> dict[str, Any]:
        """Settings on which the arrays depend, in addition to those of all instruments; part of the input hash."""

    def earlier(self, table: pd.DataFrame, row: int) -> np.ndarray:
        """Return the earlier exposures whose trapped charge is released in an exposure.

        Parameters
        ----------
        table : DataFrame
            Pointings (schema: catalogs/pointings.yaml).
        row : int
            Row of the exposure.

        Returns
        -------
        ndarray of int
            Rows of the earlier exposures, in order of time; empty for a detector without persistence.
        """

    def inputs(self, exposure: Exposure) -> tuple[tuple[str, str], ...]:
        """Return the (stage, unit) pairs that an exposure reads, in addition to the truth catalogs."""

    def leave(self, light: Light) -> pd.DataFrame:
        """Return the table of the charge that an exposure leaves in traps, for later exposures.

        Raises
        ------
        NotImplementedError
            If the detector has no persistence.
        """

    def __call__(self, light: Light, left: Sequence[tuple[Exposure, pd.DataFrame]]) -> dict[str, Any]:
        """Read out an exposure.

        Parameters
        ----------
        light : Light
            The light of the exposure.
        left : sequence of (Exposure, DataFrame)
            Earlier exposures, as selected by `earlier`, each with its table from `leave`.

        Returns
        -------
        dict
            Arrays of `variables`, the noiseless image `truth`, and tables of `tables`, by name.
        """
