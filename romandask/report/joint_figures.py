"""Pictures of the report that show both surveys at once, as PNG bytes: one field in all bands, and differences."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.patches import Circle

from romandask.report.figures import coloured, figure_of, in_sigma, png, three_of

CIRCLES = {"sharp": (26, 0.7), "blended": (260, 1.0)}
"""Area (points2) and width of the circles of objects, by the part of their survey."""


def field(
    images: dict[str, dict[str, np.ndarray]],
    red_to_blue: dict[str, tuple[str, ...]],
    half: float,
    marks: dict[str, pd.DataFrame],
) -> bytes:
    """Return one field in colour and in each band, a row a survey; circles in the first pictures, red in blends.

    Parameters
    ----------
    images : by survey and band, square and centred on one place
    red_to_blue : by survey, the bands for colours
    half : half their side, arcsec
    marks : by `sharp` and `blended`, objects of these surveys: x, y (arcsec from the middle, along the images' axes)
        and blend (True in one)
    """
    columns = max(len(bands) for bands in images.values()) + 1
    figure = figure_of(2.4 * columns, 2.6 * len(images))
    place = {"origin": "lower", "extent": (-half, half, -half, half), "interpolation": "nearest"}
    for row, (survey, bands) in enumerate(images.items()):
        names = three_of(red_to_blue[survey])
        planes = [in_sigma(bands[name]) for name in names]
        axes = figure.add_subplot(len(images), columns, row * columns + 1)
        axes.imshow(coloured(planes), **place)
        for member, (size, width) in CIRCLES.items():
            found = marks[member]
            colours = np.where(found["blend"], "red", "white")
            axes.scatter(found["x"], found["y"], s=size, facecolors="none", edgecolors=colours, linewidths=width)
        axes.set_title(f"{survey}: {', '.join(names)}", fontsize=9)
        every = [axes]
        for column, (band, image) in enumerate(bands.items()):
            axes = figure.add_subplot(len(images), columns, row * columns + column + 2)
            stretched = np.arcsinh(np.clip(in_sigma(image), -2, None) / 3)
            axes.imshow(stretched, **place, cmap="gray", vmax=float(np.percentile(stretched, 99.7)))
            axes.set_title(band, fontsize=9)
            every.append(axes)
        for axes in every:
            axes.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[])
    return png(figure)


def difference(images: dict[str, np.ndarray], sigma: np.ndarray, residuals: pd.DataFrame) -> bytes:
    """Return an image, its matched template and their difference; its pixels over their rms; the shifts that are left.

    Parameters
    ----------
    images : of one field, by title
    sigma : (n,) pixels of the whole difference over their rms
    residuals : of objects (schema: catalogs/residuals.yaml)
    """
    columns = len(images) + 2
    figure = figure_of(3.2 * columns, 3.4)
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
    errors = {"yerr": residuals["dyErr"], "xerr": residuals["dxErr"]}
    axes.errorbar(residuals["dx"], residuals["dy"], **errors, fmt=".", ms=3, lw=0.4, alpha=0.6)
    axes.add_patch(Circle((0, 0), 0.1, fill=False, color="tab:red"))
    axes.set(xlim=(-0.5, 0.5), ylim=(-0.5, 0.5), xlabel="shift in x, pixels", ylabel="shift in y")
    axes.set_aspect("equal")
    return png(figure)
