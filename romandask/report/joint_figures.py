"""Figures of the report that show both surveys, as PNG: blends, one field in all bands, and a difference image."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from romandask.report.pictures import in_noise_units, new_figure, png, rgb_bands, rgb_picture

CIRCLES = {"sharp": (26, 0.7), "blended": (260, 1.0)}
"""Area (square points) and line width (points) of the circles around objects, for the sharp and the blended survey."""


def blend_matrix(counts: pd.DataFrame, length: float) -> bytes:
    """Draw the blend matrix: the number of groups by their numbers of Roman and Rubin objects.

    Parameters
    ----------
    counts : DataFrame
        Number of groups by Roman objects (rows, up to 9 are shown) and Rubin objects (columns, up to 6 are shown).
    length : float
        Linking length, arcsec.

    Returns
    -------
    bytes
        PNG; the colour is the logarithm of the number.
    """
    shown = counts[counts.index <= 9][[column for column in counts.columns.tolist() if int(column) <= 6]]
    figure = new_figure(1.6 + 0.8 * max(3, shown.shape[1]), 1.4 + 0.5 * max(3, shown.shape[0]))
    axes = figure.add_subplot()
    values = shown.to_numpy(float)
    axes.imshow(np.log10(values + 1), origin="lower", cmap="Blues", aspect="auto")
    for row, column in np.ndindex(values.shape):
        dark = np.log10(values[row, column] + 1) > 0.6 * np.log10(values.max() + 1)
        axes.text(
            column, row, f"{int(values[row, column])}", ha="center", va="center", color="white" if dark else "black"
        )
    axes.set_xticks(range(shown.shape[1]), [str(value) for value in shown.columns])
    axes.set_yticks(range(shown.shape[0]), [str(value) for value in shown.index])
    axes.set_xlabel("Rubin objects in the group")
    axes.set_ylabel("Roman objects")
    axes.set_title(f"groups at {length:g} arcsec", fontsize=10)
    return png(figure)


def blend_fraction(tables: dict[float, pd.DataFrame], chance: dict[float, pd.DataFrame]) -> bytes:
    """Draw the fraction of unrecognised blends against i magnitude, with binomial errors, for each linking length.

    Parameters
    ----------
    tables : dict of DataFrame
        Unrecognised blends in bins of magnitude, by linking length in arcsec.
    chance : dict of DataFrame
        The same after the Rubin objects were moved. The share of objects with any Roman object is shown, dotted.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(6.5, 4)
    axes = figure.add_subplot()
    for number, (length, table) in enumerate(tables.items()):
        good = table[table["rubin_objects"] > 0]
        middle = (good["i_mag_low"] + good["i_mag_high"]) / 2
        colour, name = f"C{number}", f"{length:g} arcsec"
        axes.errorbar(middle, good["fraction"], good["error"], marker="o", capsize=2, color=colour, label=name)
        moved = chance[length].loc[good.index]
        axes.plot(middle, moved["with_roman"] / moved["rubin_objects"], ":", color=colour)
    axes.set_xlabel("Rubin i, Kron AB mag, dereddened")
    axes.set_ylabel("unrecognised blends / Rubin objects")
    axes.set_ylim(0, 1)
    axes.legend()
    return png(figure)


def blend_distributions(table: pd.DataFrame) -> bytes:
    """Draw the distributions of colour and size of blends and of single objects.

    Parameters
    ----------
    table : DataFrame
        Histograms of the stage statistics/distributions.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(10, 3.4)
    labels = {"colour": "g - F184, AB mag", "size": "half-light radius in Rubin, arcsec"}
    for position, (quantity, label) in enumerate(labels.items()):
        axes = figure.add_subplot(1, 2, position + 1)
        rows = table[table["quantity"] == quantity]
        edges = np.append(rows["low"], rows["high"].iloc[-1:])
        for column, colour in (("singles", "tab:blue"), ("blends", "tab:red")):
            total = rows[column].sum()
            axes.stairs(rows[column] / max(total, 1), edges, color=colour, label=f"{column}: {total}")
        axes.set_xlabel(label)
        axes.legend(fontsize=8)
    return png(figure)


def field(
    images: dict[str, dict[str, np.ndarray]],
    red_to_blue: dict[str, tuple[str, ...]],
    half: float,
    marks: dict[str, pd.DataFrame],
) -> bytes:
    """Draw one field in colour and in each band, one row per survey; circles in the colour pictures mark objects.

    Parameters
    ----------
    images : dict of dict of ndarray, shape (n, n)
        Images by survey and band, all centred on the same position.
    red_to_blue : dict of tuple of str
        By survey, the bands of the colour picture, red first.
    half : float
        Half the side of the images, arcsec.
    marks : dict of DataFrame
        Objects of the `sharp` and the `blended` survey. Columns: x, y (arcsec from the centre along the axes of the
        images) and blend (True for members of an unrecognised blend, which have red circles).

    Returns
    -------
    bytes
        PNG.
    """
    columns = max(len(bands) for bands in images.values()) + 1
    figure = new_figure(2.4 * columns, 2.6 * len(images))
    for row, (survey, bands) in enumerate(images.items()):
        names = rgb_bands(red_to_blue[survey])
        planes = [in_noise_units(bands[name]) for name in names]
        axes = figure.add_subplot(len(images), columns, row * columns + 1)
        _show(axes, rgb_picture(planes), half)
        for member, (size, width) in CIRCLES.items():
            objects = marks[member]
            colours = np.where(objects["blend"], "red", "white").tolist()
            axes.scatter(objects["x"], objects["y"], s=size, facecolors="none", edgecolors=colours, linewidths=width)
        axes.set_title(f"{survey}: {', '.join(names)}", fontsize=9)
        row_axes = [axes]
        for column, (band, image) in enumerate(bands.items()):
            axes = figure.add_subplot(len(images), columns, row * columns + column + 2)
            stretched = np.arcsinh(np.clip(in_noise_units(image), -2, None) / 3)
            _show(axes, stretched, half, vmax=float(np.percentile(stretched, 99.7)))
            axes.set_title(band, fontsize=9)
            row_axes.append(axes)
        for axes in row_axes:
            axes.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[])
    return png(figure)


def _show(axes: Axes, image: np.ndarray, half: float, vmax: float | None = None) -> None:
    """Show a colour picture or a grey image of 2 * half arcsec a side, centred on the origin."""
    extent = (-half, half, -half, half)
    axes.imshow(image, cmap="gray", vmax=vmax, origin="lower", extent=extent, interpolation="nearest")


def difference(images: dict[str, np.ndarray], sigma: np.ndarray, residuals: pd.DataFrame) -> bytes:
    """Draw an image, its matched template and their difference, with the distributions of pixel values and shifts.

    Parameters
    ----------
    images : dict of ndarray, shape (ny, nx)
        Images of one field, by title.
    sigma : ndarray, shape (n,)
        Pixels of the whole difference image, divided by their rms.
    residuals : DataFrame
        Residuals of objects (schema: catalogs/residuals.yaml).

    Returns
    -------
    bytes
        PNG.
    """
    columns = len(images) + 2
    figure = new_figure(3.2 * columns, 3.4)
    limit = float(np.percentile(next(iter(images.values())), 99.5))
    for position, (name, image) in enumerate(images.items()):
        axes = figure.add_subplot(1, columns, position + 1)
        axes.imshow(image, origin="lower", cmap="gray", vmin=-limit / 3, vmax=limit, interpolation="nearest")
        axes.set_title(name, fontsize=10)
        axes.set_axis_off()
    axes = figure.add_subplot(1, columns, columns - 1)
    edges = np.linspace(-8, 8, 161)
    counts, _ = np.histogram(sigma, edges)
    middle = (edges[1:] + edges[:-1]) / 2
    axes.stairs(np.maximum(counts, 1e-3) / max(counts.sum(), 1) / 0.1, edges)
    axes.plot(middle, np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi), "k:", lw=0.9)
    axes.set(yscale="log", ylim=(1e-6, 1), xlabel="difference / rms; dotted: a normal distribution")
    axes = figure.add_subplot(1, columns, columns)
    x_error, y_error = residuals["dxErr"], residuals["dyErr"]
    axes.errorbar(residuals["dx"], residuals["dy"], y_error, x_error, fmt=".", ms=3, lw=0.4, alpha=0.6)
    axes.add_patch(Circle((0, 0), 0.1, fill=False, color="tab:red"))
    axes.set(xlim=(-0.5, 0.5), ylim=(-0.5, 0.5), xlabel="shift in x, pixels", ylabel="shift in y")
    axes.set_aspect("equal")
    return png(figure)
