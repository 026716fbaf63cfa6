"""Pictures of coadds in colour, and the figure and PNG functions that all figures use."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.visualization import make_lupton_rgb
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

LARGEST_PICTURE_PIXELS = 1600
"""Largest side of a picture of a tile, pixels; of a larger tile only the centre is shown."""


@dataclass(frozen=True)
class TileImages:
    """Coadds of one tile of a survey."""

    bands: dict[str, np.ndarray]
    """Images by band, each of shape (ny, nx)."""
    red_to_blue: tuple[str, ...]
    """Bands of the colour picture, red first."""
    scale: float
    """Pixel scale, arcsec."""


def colour_pair(tiles: dict[str, TileImages], objects: dict[str, pd.DataFrame]) -> bytes:
    """Draw a tile in colour as each survey sees it, side by side.

    Parameters
    ----------
    tiles : dict of TileImages
        Images of the tile, by survey.
    objects : dict of DataFrame
        Detected objects of the tile, by survey; they have circles. Columns: x, y, pixels.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(7.2 * len(tiles), 7.4)
    extent = min(min(next(iter(tile.bands.values())).shape) * tile.scale for tile in tiles.values())
    # the same part of the sky for every survey
    extent = min(extent, LARGEST_PICTURE_PIXELS * min(tile.scale for tile in tiles.values()))
    for position, (survey, tile) in enumerate(tiles.items()):
        axes = figure.add_subplot(1, len(tiles), position + 1)
        chosen, scale = rgb_bands(tile.red_to_blue), tile.scale
        side = next(iter(tile.bands.values())).shape[0]
        count = int(extent / scale)
        first = (side - count) // 2
        cut = slice(first, first + count)
        planes = [in_noise_units(tile.bands[name][cut, cut]) for name in chosen]
        picture = rgb_picture(planes)
        half = count * scale / 2
        axes.imshow(picture, origin="lower", extent=(-half, half, -half, half), interpolation="nearest")
        circled = objects.get(survey)
        if circled is not None and len(circled):
            x, y = (circled[name].to_numpy() * scale - side * scale / 2 for name in ("x", "y"))
            axes.scatter(x, y, s=26, facecolors="none", edgecolors="white", linewidths=0.35)
        axes.set_xlim(-half, half)
        axes.set_ylim(-half, half)
        axes.set_title(f"{survey}: {', '.join(chosen)}; {scale:g} arcsec pixels")
        axes.set_xlabel("arcsec west")
    return png(figure)


def coverage_maps(tiles: dict[str, tuple[np.ndarray, np.ndarray, str]]) -> bytes:
    """Draw the weight and the number of exposures of a tile in one band, for each survey.

    Parameters
    ----------
    tiles : dict of tuple
        (weight, nimages, band) by survey; weight and nimages have the shape (ny, nx).

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(4.2 * 2 * len(tiles), 3.9)
    position = 0
    for survey, (weight, count, band) in tiles.items():
        for values, name in ((weight, "weight"), (count, "exposures")):
            position += 1
            axes = figure.add_subplot(1, 2 * len(tiles), position)
            step = max(1, values.shape[0] // 800)
            shown = axes.imshow(values[::step, ::step], origin="lower", interpolation="nearest")
            axes.set_title(f"{survey} {band} {name}", fontsize=10)
            axes.set_axis_off()
            figure.colorbar(shown, ax=axes, fraction=0.046)
    return png(figure)


def rgb_bands(red_to_blue: tuple[str, ...]) -> tuple[str, str, str]:
    """Return the red, green and blue band of a colour picture; with fewer than three bands, bands repeat.

    Parameters
    ----------
    red_to_blue : tuple of str
        Bands, reddest first.
    """
    return red_to_blue[0], red_to_blue[len(red_to_blue) // 2], red_to_blue[-1]


def rgb_picture(planes: Sequence[np.ndarray]) -> np.ndarray:
    """Return a colour picture (ny, nx, 3) of three images (ny, nx) in units of their noise, red first."""
    return make_lupton_rgb(*planes, minimum=-1.0, stretch=12.0, Q=8.0)


def in_noise_units(plane: np.ndarray) -> np.ndarray:
    """Return an image divided by its noise (see `noise_of`)."""
    return plane / noise_of(plane)


def noise_of(plane: np.ndarray) -> float:
    """Return the noise of an image, 1.4826 times its median absolute deviation; 1 if that is 0."""
    sigma = 1.4826 * np.median(np.abs(plane - np.median(plane)))
    return sigma if sigma > 0 else 1.0


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of the given width and height, inches."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return the PNG of a figure. Without the software version, equal figures have equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
