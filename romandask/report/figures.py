"""Figures of the report about one survey or both, as PNG: inputs, exposures, detectors, measurements and shear."""

from __future__ import annotations

import numpy as np
import pandas as pd

from romandask.model.sky import Region, covering_sums
from romandask.model.spectra import ab_magnitude
from romandask.report.pictures import new_figure, png


def effects(images: dict[str, np.ndarray]) -> bytes:
    """Draw the difference that each detector effect makes to an image, one panel per effect with its own colour scale.

    Parameters
    ----------
    images : dict of ndarray, shape (ny, nx)
        Difference images by effect, electrons.

    Returns
    -------
    bytes
        PNG.
    """
    columns = 4
    rows = -(-len(images) // columns)
    figure = new_figure(3.3 * columns, 3.1 * rows)
    for position, (name, image) in enumerate(images.items()):
        axes = figure.add_subplot(rows, columns, position + 1)
        # the scale follows the percentile, or a tenth of the maximum where the effect changes few pixels
        strength = np.abs(image)
        limit = max(float(np.percentile(strength, 99.5)), float(strength.max()) / 10, 1e-3)
        shown = axes.imshow(image, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        axes.set_title(name)
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(shown, ax=axes, shrink=0.85)
    return png(figure)


def input_distributions(galaxies: pd.DataFrame, stars: pd.DataFrame, area: float, bands: tuple[str, ...]) -> bytes:
    """Draw the distributions of the true objects by component, as in Troxel et al. (2023), figure 2.

    Parameters
    ----------
    galaxies, stars : DataFrame
        True galaxies and stars of the region.
    area : float
        Solid angle of the region, square arcmin.
    bands : tuple of str
        Bands of the number counts (the first four are used); the colour is the first minus the last.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(15.0, 7.6)
    axes = figure.subplots(2, 4).ravel()
    edges = np.arange(14, 32.1, 0.5)
    # an empty histogram has no logarithmic scale
    count_scale = "log" if len(galaxies) else "linear"
    for band in bands[:4]:
        for frame, line in ((galaxies, "-"), (stars, ":")):
            counts, _ = np.histogram(ab_magnitude(frame[f"flux_{band}"]), edges)
            axes[0].stairs(counts / area / 0.5, edges, linestyle=line, label=band if line == "-" else None)
    axes[0].set(yscale=count_scale, xlabel="AB mag", ylabel="a mag and arcmin$^2$", title="Counts (dotted: stars)")
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
    axes[2].set(yscale=count_scale, xlabel="magnorm", title="Brightness by component")
    axes[3].set(xscale="log", xlabel="half-light radius, arcsec", title="Sizes")
    axes[4].set(xlabel="(a - b) / (a + b)", title="Shapes before lensing")
    for panel in axes[2:5]:
        panel.legend(fontsize=8)
    first, last, colours = bands[0], bands[-1], np.arange(-2, 6, 0.15)
    for frame, name in ((galaxies, "galaxies"), (stars, "stars")):
        colour = ab_magnitude(frame[f"flux_{first}"]) - ab_magnitude(frame[f"flux_{last}"])
        shares = np.histogram(colour, colours)[0] / max(1, len(colour)) / np.diff(colours)
        axes[5].stairs(shares, colours, label=name)
    axes[5].set(xlabel=f"{first} - {last}", title="Colours")
    axes[5].legend(fontsize=8)
    axes[6].hist(galaxies["convergence"], 60, histtype="step", label="$\\kappa$")
    axes[6].hist(np.hypot(galaxies["shear_1"], galaxies["shear_2"]), 60, histtype="step", label="$|\\gamma|$")
    axes[6].set(yscale=count_scale, title="Lensing")
    axes[6].legend(fontsize=8)
    with_knots = galaxies["n_knots"] > 0
    axes[7].hist(galaxies.loc[with_knots, "n_knots"], np.arange(0, 33, 1), histtype="step")
    axes[7].set(xlabel="knots", title=f"Knots: {with_knots.mean():.1%} of galaxies have them")
    return png(figure)


def exposure_maps(region: Region, footprints: dict[str, np.ndarray]) -> bytes:
    """Draw a map and a histogram of the number of exposures over a region, for each band.

    Parameters
    ----------
    region : Region
        Region of the survey.
    footprints : dict of ndarray, shape (n, 4, 2), degrees
        Corners (right ascension, declination) of the exposures, by band.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(3.6 * len(footprints), 6.2)
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
    """Draw histograms of true and measured magnitudes with a line at the depth, one panel per band.

    Parameters
    ----------
    true, measured : dict of ndarray
        AB magnitudes by band; values that are not finite are left out.
    depth : dict of float
        5-sigma depth of point sources by band, AB mag.

    Returns
    -------
    bytes
        PNG.
    """
    bands = list(true)
    figure = new_figure(14, 2.9 * -(-len(bands) // 5))
    edges = np.arange(16, 31.01, 0.5).tolist()
    for position, band in enumerate(bands):
        axes = figure.add_subplot(-(-len(bands) // 5), 5, position + 1)
        axes.hist(true[band][np.isfinite(true[band])], edges, histtype="step", color="0.35", label="true, all")
        magnitudes = measured[band]
        axes.hist(magnitudes[np.isfinite(magnitudes)], edges, color="tab:blue", alpha=0.5, label="measured")
        if np.isfinite(depth[band]):
            axes.axvline(depth[band], color="tab:red", lw=1, ls="--", label=f"depth {depth[band]:.2f}")
        axes.set_yscale("symlog", linthresh=1)
        axes.set_title(band, fontsize=10)
        axes.set_xlabel("AB mag")
        axes.legend(fontsize=7)
    return png(figure)


def colour_histograms(colours: dict[str, tuple[np.ndarray, np.ndarray]]) -> bytes:
    """Draw histograms of true and measured colours, one panel per pair of bands.

    Parameters
    ----------
    colours : dict of tuple of ndarray
        (true, measured) colours, AB mag, by the name of the pair.

    Returns
    -------
    bytes
        PNG.
    """
    columns = max(1, min(4, len(colours)))
    rows = max(1, -(-len(colours) // columns))
    figure = new_figure(3.6 * columns, 2.7 * rows)
    edges = np.arange(-1.5, 3.01, 0.1).tolist()
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
    """Draw bias and scatter of magnitudes, pulls of fluxes and the flagged share by magnitude, one column per survey.

    Parameters
    ----------
    tables : dict of DataFrame
        By survey, the result of `romandask.stages.analysis.validation.residuals`. Bins of fewer than five objects are
        not shown.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(6.5 * len(tables), 8.4)
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
                # shifted by band, so that error bars do not overlap
                magnitude = part["magnitude"] + 0.03 * (number - 2)
                error = part[spread] if spread else None
                axes.errorbar(magnitude, part[name], error, fmt="o-", ms=3, lw=0.9, elinewidth=0.7, label=band)
            axes.set_ylim(*limits)
            axes.set_ylabel(label)
            axes.set_xlabel(f"{survey}, true AB mag")
            if row == 0 and len(shown):
                axes.legend(fontsize=8, ncols=3)
    return png(figure)


def size_magnitude(objects: dict[str, pd.DataFrame], bands: dict[str, str]) -> bytes:
    """Draw the half-light radius against the Kron magnitude for each survey, point-like objects in red.

    Parameters
    ----------
    objects : dict of DataFrame
        Detected objects by survey.
    bands : dict of str
        Band of the magnitude by survey.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(6 * len(objects), 4.2)
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
    """Draw completeness and purity by magnitude, and measured minus true magnitudes, for each survey.

    Parameters
    ----------
    tables : dict of DataFrame
        Completeness and purity in bins of magnitude, by survey.
    matched : dict of DataFrame
        Objects with their true counterparts, by survey; stars are shown in red.
    bands : dict of str
        Band of the magnitudes by survey.

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(6 * len(tables), 6.4)
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


def shear(tables: dict[str, pd.DataFrame]) -> bytes:
    """Draw xi+ and xi- of each survey against separation, with the theory.

    Parameters
    ----------
    tables : dict of DataFrame
        Two-point functions by survey (schema: catalogs/shear.yaml).

    Returns
    -------
    bytes
        PNG.
    """
    figure = new_figure(10, 3.8)
    for position, function in enumerate(("xip", "xim")):
        axes = figure.add_subplot(1, 2, position + 1)
        for number, (survey, table) in enumerate(tables.items()):
            # shifted by survey, so that error bars do not overlap
            shifted, colour = table["separation"] * (1 + 0.04 * number), f"C{number}"
            value, error = shifted * table[function] * 1e4, shifted * table[f"{function}_error"] * 1e4
            axes.errorbar(shifted, value, error, fmt="o", ms=3, color=colour, label=survey)
            axes.plot(shifted, table["separation"] * table[f"{function}_theory"] * 1e4, color=colour, lw=0.9)
        axes.axhline(0, color="0.8", lw=0.8)
        axes.set_xscale("log")
        axes.set_xlabel("arcmin")
        axes.set_ylabel(f"separation $\\xi_{'+' if function == 'xip' else '-'}$, $10^{{-4}}$ arcmin")
        axes.legend(fontsize=8)
    return png(figure)
