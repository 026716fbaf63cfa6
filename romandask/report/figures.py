"""Pictures of the report, as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from astropy.visualization import make_lupton_rgb
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from romandask.model.sky import Region, covering_sums
from romandask.model.spectra import ab_magnitude

LARGEST_PICTURE_PIXELS = 1600
"""Pixels a side of a picture of a tile; larger tiles are shown by their middle."""


@dataclass(frozen=True)
class TileImages:
    """The images of one tile as a survey sees it."""

    bands: dict[str, np.ndarray]
    """By band, (ny, nx)."""
    red_to_blue: tuple[str, ...]
    """Bands for colours."""
    scale: float
    """arcsec a pixel"""


def colour_pair(tiles: dict[str, TileImages], objects: dict[str, pd.DataFrame]) -> bytes:
    """Return the same sky in colour as each survey sees it, side by side.

    Parameters
    ----------
    tiles : dict of str to TileImages
        By survey.
    objects : dict of str to DataFrame
        By survey, the detected objects of the tile, circled.
    """
    figure = figure_of(7.2 * len(tiles), 7.4)
    extent = min(min(next(iter(tile.bands.values())).shape) * tile.scale for tile in tiles.values())
    # very large tiles are shown by their middle, the same sky for every survey
    extent = min(extent, LARGEST_PICTURE_PIXELS * min(tile.scale for tile in tiles.values()))
    for position, (survey, tile) in enumerate(tiles.items()):
        axes = figure.add_subplot(1, len(tiles), position + 1)
        chosen, scale = three_of(tile.red_to_blue), tile.scale
        side = next(iter(tile.bands.values())).shape[0]
        count = int(extent / scale)
        first = (side - count) // 2
        cut = slice(first, first + count)
        planes = [in_sigma(tile.bands[name][cut, cut]) for name in chosen]
        picture = coloured(planes)
        half = count * scale / 2
        axes.imshow(picture, origin="lower", extent=(-half, half, -half, half), interpolation="nearest")
        found = objects.get(survey)
        if found is not None and len(found):
            x, y = (found[name].to_numpy() * scale - side * scale / 2 for name in ("x", "y"))
            axes.scatter(x, y, s=26, facecolors="none", edgecolors="white", linewidths=0.35)
        axes.set_xlim(-half, half)
        axes.set_ylim(-half, half)
        axes.set_title(f"{survey}: {', '.join(chosen)}; {scale:g} arcsec pixels")
        axes.set_xlabel("arcsec west")
    return png(figure)


def three_of(red_to_blue: tuple[str, ...]) -> tuple[str, str, str]:
    """Return which bands are red, green and blue; where there are fewer than three, one has several of these parts."""
    return red_to_blue[0], red_to_blue[len(red_to_blue) // 2], red_to_blue[-1]


def coloured(planes: Sequence[np.ndarray]) -> np.ndarray:
    """Return a picture (ny, nx, 3) of three planes, red first, in units of their noise."""
    return make_lupton_rgb(*planes, minimum=-1.0, stretch=12.0, Q=8.0)


def effects(images: dict[str, np.ndarray]) -> bytes:
    """Return difference images (electrons), a panel an effect, each with its own scale."""
    columns = 4
    rows = -(-len(images) // columns)
    figure = figure_of(3.3 * columns, 3.1 * rows)
    for position, (name, image) in enumerate(images.items()):
        axes = figure.add_subplot(rows, columns, position + 1)
        # what is everywhere decides the scale, or a tenth of the strongest where that is rare
        strength = np.abs(image)
        limit = max(float(np.percentile(strength, 99.5)), float(strength.max()) / 10, 1e-3)
        shown = axes.imshow(image, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        axes.set_title(name)
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(shown, ax=axes, shrink=0.85)
    return png(figure)


def maps(tiles: dict[str, tuple[np.ndarray, np.ndarray, str]]) -> bytes:
    """Return weight and number of exposures of a tile in one band, by survey: (weight, nimages, band)."""
    figure = figure_of(4.2 * 2 * len(tiles), 3.9)
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


def input_distributions(galaxies: pd.DataFrame, stars: pd.DataFrame, area: float, bands: tuple[str, ...]) -> bytes:
    """Return the distributions of the true objects by component, as in Troxel et al. 2023, figure 2.

    `area` is in square arcminutes; `bands` are up to four whose counts and colour are shown.
    """
    figure = figure_of(15.0, 7.6)
    axes = figure.subplots(2, 4).ravel()
    edges = np.arange(14, 32.1, 0.5)
    # nothing has no logarithm
    counted = "log" if len(galaxies) else "linear"
    for band in bands[:4]:
        for frame, line in ((galaxies, "-"), (stars, ":")):
            counts, _ = np.histogram(ab_magnitude(frame[f"flux_{band}"]), edges)
            axes[0].stairs(counts / area / 0.5, edges, linestyle=line, label=band if line == "-" else None)
    axes[0].set(yscale=counted, xlabel="AB mag", ylabel="a mag and arcmin$^2$", title="Counts (dotted: stars)")
    axes[0].legend(fontsize=8)
    axes[1].hist(galaxies["redshift"], np.arange(0, 3.2, 0.1), histtype="step")
    axes[1].set(xlabel="redshift", title="Galaxies")
    lit = {name: np.isfinite(galaxies[f"{name}_magnorm"]) for name in ("bulge", "disk", "knots")}
    for name, rows in lit.items():
        axes[2].hist(galaxies.loc[rows, f"{name}_magnorm"], np.arange(14, 40, 0.5), histtype="step", label=name)
        if name == "knots":
            continue
        major, minor = (galaxies.loc[rows, f"size_{axis}{name}_true"] for axis in ("", "minor_"))
        axes[3].hist(np.sqrt(major * minor), np.geomspace(0.01, 10, 50), histtype="step", label=name)
        axes[4].hist((major - minor) / (major + minor), np.arange(0, 1, 0.03), histtype="step", label=name)
    axes[2].set(yscale=counted, xlabel="magnorm", title="Brightness by component")
    axes[3].set(xscale="log", xlabel="half-light radius, arcsec", title="Sizes")
    axes[4].set(xlabel="(a - b) / (a + b)", title="Shapes before lensing")
    for each in axes[2:5]:
        each.legend(fontsize=8)
    first, last, colours = bands[0], bands[-1], np.arange(-2, 6, 0.15)
    for frame, name in ((galaxies, "galaxies"), (stars, "stars")):
        colour = ab_magnitude(frame[f"flux_{first}"]) - ab_magnitude(frame[f"flux_{last}"])
        shares = np.histogram(colour, colours)[0] / max(1, len(colour)) / np.diff(colours)
        axes[5].stairs(shares, colours, label=name)
    axes[5].set(xlabel=f"{first} - {last}", title="Colours")
    axes[5].legend(fontsize=8)
    axes[6].hist(galaxies["convergence"], 60, histtype="step", label="$\\kappa$")
    axes[6].hist(np.hypot(galaxies["shear_1"], galaxies["shear_2"]), 60, histtype="step", label="$|\\gamma|$")
    axes[6].set(yscale=counted, title="Lensing")
    axes[6].legend(fontsize=8)
    some = galaxies["n_knots"] > 0
    axes[7].hist(galaxies.loc[some, "n_knots"], np.arange(0, 33, 1), histtype="step")
    axes[7].set(xlabel="knots", title=f"Knots: {some.mean():.1%} of galaxies have them")
    return png(figure)


def exposure_maps(region: Region, footprints: dict[str, np.ndarray]) -> bytes:
    """Return how many exposures (by band: corners (n, 4, 2), degrees) points of a region have: map and histogram."""
    figure = figure_of(3.6 * len(footprints), 6.2)
    axes = figure.subplots(2, len(footprints), squeeze=False)
    ra = region.ra_min + region.width * (np.arange(150) + 0.5) / 150
    dec = region.dec_min + (region.dec_max - region.dec_min) * (np.arange(150) + 0.5) / 150
    weight = np.cos(np.radians(dec))[:, None] * np.ones(len(ra))
    for column, (band, corners) in enumerate(footprints.items()):
        counts = covering_sums(corners, ra[None, :], dec[:, None])
        extent = (region.ra_min, region.ra_min + region.width, region.dec_min, region.dec_max)
        image = axes[0, column].imshow(counts, origin="lower", extent=extent, aspect="auto", interpolation="nearest")
        axes[0, column].set(title=f"{band}: mean {np.average(counts, weights=weight):.1f}", xlabel="RA, degrees")
        axes[0, column].invert_xaxis()
        figure.colorbar(image, ax=axes[0, column])
        bins = np.arange(counts.max() + 2) - 0.5
        axes[1, column].hist(counts.ravel(), bins, weights=weight.ravel() / weight.sum())
        axes[1, column].set(xlabel="exposures", ylabel="share of the area" if column == 0 else "")
    return png(figure)


def magnitude_histograms(
    true: dict[str, np.ndarray], measured: dict[str, np.ndarray], depth: dict[str, float]
) -> bytes:
    """Return histograms of true and measured magnitudes with lines at the depths, a panel a band."""
    bands = list(true)
    figure = figure_of(14, 2.9 * -(-len(bands) // 5))
    edges = np.arange(16, 31.01, 0.5)
    for position, band in enumerate(bands):
        axes = figure.add_subplot(-(-len(bands) // 5), 5, position + 1)
        axes.hist(true[band][np.isfinite(true[band])], edges, histtype="step", color="0.35", label="true, all")
        found = measured[band]
        axes.hist(found[np.isfinite(found)], edges, color="tab:blue", alpha=0.5, label="measured")
        if np.isfinite(depth[band]):
            axes.axvline(depth[band], color="tab:red", lw=1, ls="--", label=f"depth {depth[band]:.2f}")
        axes.set_yscale("symlog", linthresh=1)
        axes.set_title(band, fontsize=10)
        axes.set_xlabel("AB mag")
        axes.legend(fontsize=7)
    return png(figure)


def colour_histograms(colours: dict[str, tuple[np.ndarray, np.ndarray]]) -> bytes:
    """Return histograms of true and measured colours, a panel a pair of bands."""
    columns = max(1, min(4, len(colours)))
    rows = max(1, -(-len(colours) // columns))
    figure = figure_of(3.6 * columns, 2.7 * rows)
    edges = np.arange(-1.5, 3.01, 0.1)
    for position, (name, (true, measured)) in enumerate(colours.items()):
        axes = figure.add_subplot(rows, columns, position + 1)
        axes.hist(true, edges, histtype="step", color="0.35", label="true")
        axes.hist(measured, edges, color="tab:blue", alpha=0.5, label="measured")
        axes.set_title(f"{name}: {len(true)}", fontsize=10)
        axes.set_xlabel("AB mag")
        if position == 0:
            axes.legend(fontsize=8)
    return png(figure)


def residuals(tables: dict[str, pd.DataFrame]) -> bytes:
    """Return bias and scatter of magnitudes, pulls of fluxes and the flagged share by magnitude, a column a survey.

    `tables` are those of `stages.analysis.validation.residuals`; bins of fewer than five objects are not shown.
    """
    figure = figure_of(6.5 * len(tables), 8.4)
    panels = (
        ("bias", "scatter", "measured less true, mag", (-0.6, 0.6)),
        ("pull", "pull_scatter", "pull", (-4, 4)),
        ("flagged", None, "flagged share", (0, 1)),
    )
    for column, (survey, table) in enumerate(tables.items()):
        shown = table[table["objects"] >= 5]
        for row, (name, spread, label, limits) in enumerate(panels):
            axes = figure.add_subplot(3, len(tables), row * len(tables) + column + 1)
            axes.axhline(0, color="0.8", lw=0.8)
            for number, (band, part) in enumerate(shown.groupby("band", sort=False)):
                place = part["magnitude"] + 0.03 * (number - 2)
                error = part[spread] if spread else None
                axes.errorbar(place, part[name], error, fmt="o-", ms=3, lw=0.9, elinewidth=0.7, label=band)
            axes.set_ylim(*limits)
            axes.set_ylabel(label)
            axes.set_xlabel(f"{survey}, true AB mag")
            if row == 0 and len(shown):
                axes.legend(fontsize=8, ncols=3)
    return png(figure)


def size_magnitude(objects: dict[str, pd.DataFrame], bands: dict[str, str]) -> bytes:
    """Return the half-light radius against magnitude for each survey; point-like objects in colour."""
    figure = figure_of(6 * len(objects), 4.2)
    for position, (survey, frame) in enumerate(objects.items()):
        axes = figure.add_subplot(1, len(objects), position + 1)
        magnitude = ab_magnitude(frame[f"{bands[survey]}_kronFlux"])
        extended = frame["extendedness"].to_numpy() > 0
        for chosen, colour, name in ((extended, "0.5", "extended"), (~extended, "tab:red", "point-like")):
            axes.scatter(magnitude[chosen], frame["half_light_radius"][chosen], s=7, color=colour, label=name)
        if len(frame):
            axes.set_yscale("log")
        axes.set_xlabel(f"{survey} {bands[survey]}, Kron AB mag")
        axes.set_ylabel("half-light radius, arcsec")
        axes.legend(fontsize=8)
    return png(figure)


def completeness(tables: dict[str, pd.DataFrame], matched: dict[str, pd.DataFrame], bands: dict[str, str]) -> bytes:
    """Return completeness and purity by magnitude, and measured less true magnitudes, of each survey."""
    figure = figure_of(6 * len(tables), 6.4)
    for position, (survey, table) in enumerate(tables.items()):
        axes = figure.add_subplot(2, len(tables), position + 1)
        for name, colour in (("completeness", "tab:blue"), ("purity", "tab:orange")):
            known = table[table[name].notna()]
            axes.plot(known["magnitude"], known[name], "o-", ms=3, color=colour, label=name)
        axes.set_ylim(0, 1.05)
        axes.set_xlabel(f"{survey} {bands[survey]}, AB mag")
        axes.legend(fontsize=8)
        axes = figure.add_subplot(2, len(tables), len(tables) + position + 1)
        frame = matched[survey]
        axes.axhline(0, color="0.7", lw=0.8)
        difference = frame["magnitude"] - frame["true_magnitude"]
        axes.scatter(frame["true_magnitude"], difference, s=5, c=np.where(frame["star"], "tab:red", "0.5"))
        axes.set_ylim(-1.5, 1.5)
        axes.set_xlabel(f"true {bands[survey]}, AB mag")
        axes.set_ylabel("measured less true, mag")
    return png(figure)


def blend_matrix(counts: pd.DataFrame, length: float) -> bytes:
    """Return the blend matrix: log number of groups by Roman (rows) and Rubin (columns) objects."""
    shown = counts[counts.index <= 9][[c for c in counts.columns if c <= 6]]
    figure = figure_of(1.6 + 0.8 * max(3, shown.shape[1]), 1.4 + 0.5 * max(3, shown.shape[0]))
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
    """Return the fraction of unrecognised blends against i magnitude, with binomial errors, by linking length.

    `chance` are the same tables of a moved sky: of them the share with any Roman object is shown.
    """
    figure = figure_of(6.5, 4)
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
    """Return distributions of colour and size of blends and of single objects (statistics/distributions)."""
    figure = figure_of(10, 3.4)
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


def shear(tables: dict[str, pd.DataFrame]) -> bytes:
    """Return xi+ and xi- against separation with theory, by survey (catalogs/shear.yaml)."""
    figure = figure_of(10, 3.8)
    for position, kind in enumerate(("xip", "xim")):
        axes = figure.add_subplot(1, 2, position + 1)
        for number, (survey, table) in enumerate(tables.items()):
            place = table["separation"] * (1 + 0.04 * number)
            style = {"fmt": "o", "ms": 3, "color": f"C{number}", "label": survey}
            axes.errorbar(place, place * table[kind] * 1e4, place * table[f"{kind}_error"] * 1e4, **style)
            axes.plot(place, table["separation"] * table[f"{kind}_theory"] * 1e4, color=f"C{number}", lw=0.9)
        axes.axhline(0, color="0.8", lw=0.8)
        axes.set_xscale("log")
        axes.set_xlabel("arcmin")
        axes.set_ylabel(f"separation $\\xi_{'+' if kind == 'xip' else '-'}$, $10^{{-4}}$ arcmin")
        axes.legend(fontsize=8)
    return png(figure)


def in_sigma(plane: np.ndarray) -> np.ndarray:
    """Return an image in units of its own noise."""
    return plane / noise_of(plane)


def noise_of(plane: np.ndarray) -> float:
    """Return the noise of an image by its median absolute deviation; 1 where it has none."""
    sigma = 1.4826 * np.median(np.abs(plane - np.median(plane)))
    return sigma if sigma > 0 else 1.0


def figure_of(width: float, height: float) -> Figure:
    """Return an empty figure of some size, inches."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
