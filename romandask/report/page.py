"""Report of a survey: one HTML page without external assets."""

from __future__ import annotations

import html
from itertools import pairwise

import numpy as np
import pandas as pd

from romandask.model.spectra import ab_magnitude
from romandask.report import figures, pictures
from romandask.report.html import image_of, table_of
from romandask.report.joint import blends, difference_images, field
from romandask.run import run_figures, stored_versions
from romandask.stages.analysis.two_point import significance
from romandask.stages.analysis.validation import colours_of, depths, residuals, with_truth
from romandask.stages.pointings import corners_of
from romandask.storage.paths import AnyPath, bytes_below, write_bytes
from romandask.survey import Survey

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2em auto; padding: 0 1em; color: #1c2430; }
h1 { margin-bottom: 0 } h2 { margin-top: 2em; border-bottom: 1px solid #d5dbe3 }
img { max-width: 100%; height: auto } figure { margin: 1em 0 } figcaption { color: #55606e; font-size: 13px }
table { border-collapse: collapse; font-variant-numeric: tabular-nums } td, th { padding: 2px 12px; text-align: right }
th { border-bottom: 1px solid #888 } td:first-child, th:first-child { text-align: left }
"""


def write_report(survey: Survey) -> AnyPath:
    """Write the report of a stored survey to its store and return the path of the page."""
    assert survey.store is not None
    objects = {name: survey.output(f"objects/{name}").all_rows() for name in survey.instruments}
    busiest = _busiest_tile(survey, objects)
    sections = [
        _overview(survey, objects),
        _inputs(survey),
        _sky(survey, objects, busiest),
        _detector(survey),
        _measurements(survey, objects),
        blends(survey),
        field(survey, objects, busiest),
        difference_images(survey),
        _lensing(survey),
        _run_statistics(survey),
    ]
    title = html.escape(f"romandask: {survey.pipeline.name}")
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    )
    path = survey.store.report / "index.html"
    write_bytes(path, (page + "".join(sections) + "</html>\n").encode())
    return path


def _overview(survey: Survey, objects: dict[str, pd.DataFrame]) -> str:
    region = survey.region
    text = (
        f"<p>{html.escape(survey.pipeline.description)}</p><p>Region: RA {region.ra_min:g} to {region.ra_max:g}, Dec "
        f"{region.dec_min:g} to {region.dec_max:g} degrees; true solid angle {region.area:.3f} arcmin<sup>2</sup>; "
        f"{len(survey.tiles)} tiles.</p>"
    )
    rows = []
    for name, frame in objects.items():
        count = len(survey.pointings(name))
        rows.append(
            {
                "survey": name,
                "exposures": count,
                "objects": len(frame),
                "objects / arcmin2": f"{len(frame) / region.area:.1f}",
            }
        )
    return text + table_of(pd.DataFrame(rows))


def _sky(survey: Survey, objects: dict[str, pd.DataFrame], tile: int) -> str:
    pairs, layers = {}, {}
    for name, instrument in survey.instruments.items():
        coadds = survey.output(f"coadds/{name}")
        bands = {}
        for position, band in enumerate(instrument.bands):
            arrays = coadds.read(tile, band, ("image", "weight", "nimages"))
            bands[band] = arrays["image"]
            if position == len(instrument.bands) // 2:
                layers[name] = (arrays["weight"], arrays["nimages"], band)
        pairs[name] = pictures.TileImages(bands, instrument.picture_bands, instrument.coadd_scale)
    label = survey.tiles[tile].name
    circled = {name: frame[frame["tile"] == label] for name, frame in objects.items()}
    return (
        "<h2>The same sky</h2>"
        + image_of(
            pictures.colour_pair(pairs, circled),
            f"Tile {label} in the coadds of each survey. Circles: objects in the unique area of the tile.",
        )
        + image_of(pictures.coverage_maps(layers), "Weight and number of exposures at each pixel of the tile.")
    )


def _detector(survey: Survey) -> str:
    """Return the section on the effects of detectors that are modelled in full."""
    text = ""
    for name, instrument in survey.instruments.items():
        if not instrument.calibrated:
            continue
        exposures = survey.output(f"exposures/{name}")
        earlier, table = exposures.renderer.readout.earlier, exposures.table
        # prefer an exposure with an afterglow of earlier exposures
        index = next((row for row in range(len(table)) if len(earlier(table, row))), 0)
        text += "<h2>The detectors</h2>" + image_of(
            figures.effects(exposures.effects(index)),
            f"Effects of the detector around the brightest star of exposure {exposures.names[index]}: the image with "
            "each effect minus the image without it, with the same random numbers, in electrons.",
        )
    return text


def _inputs(survey: Survey) -> str:
    catalogs = survey.truth_catalogs
    frames = [catalogs.galaxies.all_rows(), catalogs.stars.all_rows()]
    galaxies, stars = (frame[survey.region.contains(frame["ra"], frame["dec"])] for frame in frames)
    bands = tuple(survey.bandpasses)
    references = [instrument.reference_band for instrument in survey.instruments.values()]
    shown = tuple(dict.fromkeys(band for band in (*references, bands[0], bands[-1])))[:4]
    text = "<h2>Truth and exposures</h2>" + image_of(
        figures.input_distributions(galaxies, stars, survey.region.area, shown),
        f"Distributions of {len(galaxies)} galaxies and {len(stars)} stars of the region, and of galaxy components.",
    )
    for name, instrument in survey.instruments.items():
        table = survey.pointings(name)
        footprints = {band: corners_of(table[table["band"] == band]) for band in instrument.bands}
        text += image_of(
            figures.exposure_maps(survey.region, footprints),
            f"Number of {instrument.title} exposures over the region, by band.",
        )
    return text


def _measurements(survey: Survey, objects: dict[str, pd.DataFrame]) -> str:
    catalogs = survey.truth_catalogs
    truth = [catalogs.galaxies.all_rows(), catalogs.stars.all_rows()]
    truth = [frame[survey.region.contains(frame["ra"], frame["dec"])] for frame in truth]
    true, measured, middle, colours = {}, {}, {}, {}
    depth = {
        str(band): float(value) for name in objects for band, value in depths(objects[name], survey.bands(name)).items()
    }
    matched = {name: survey.output(f"truth_match/{name}").all_rows() for name in objects}
    joined = {
        name: with_truth(frame, matched[name], survey.output(f"truth_summary/{name}").all_rows())
        for name, frame in objects.items()
    }
    for name, frame in objects.items():
        bands = survey.bands(name)
        middle[name] = bands[len(bands) // 2]
        for band in bands:
            true[band] = ab_magnitude(pd.concat([part[f"flux_{band}"] for part in truth]))
            measured[band] = ab_magnitude(frame[f"{band}_kronFlux"])
        for pair in pairwise(bands):
            colours[" - ".join(pair)] = colours_of(joined[name], *pair)
    residual_tables = {name: residuals(frame, survey.bands(name)) for name, frame in joined.items()}
    return (
        "<h2>Measurements</h2>"
        + _comparison_with_paper(survey, objects, joined, depth)
        + image_of(
            figures.magnitude_histograms(true, measured, depth),
            "Magnitudes of all true objects of the region, and Kron magnitudes of the detected objects. Lines: 5-sigma "
            "depths of point sources.",
        )
        + (
            image_of(
                figures.colour_histograms(colours),
                "Colours of objects with a signal to noise above 10 in both bands: true (grey) and measured.",
            )
            if colours
            else ""
        )
        + image_of(
            figures.size_magnitude(objects, middle),
            "Size against magnitude; point sources lie at the size of the PSF.",
        )
        + image_of(
            figures.residuals(residual_tables),
            "Residuals by true magnitude: Kron minus true magnitude (median and scatter), pulls of the fluxes "
            "(residual over error, median and scatter), and the fraction of flagged objects.",
        )
        + image_of(
            figures.completeness(
                {name: survey.completeness(name) for name in survey.instruments},
                matched,
                {name: instrument.reference_band for name, instrument in survey.instruments.items()},
            ),
            "Completeness by true magnitude, purity by measured magnitude, and Kron magnitudes minus those of the true "
            "counterparts; stars are red.",
        )
    )


def _comparison_with_paper(
    survey: Survey, objects: dict[str, pd.DataFrame], joined: dict[str, pd.DataFrame], depth: dict[str, float]
) -> str:
    """Return a table of depths, densities and flagged shares with the values of Troxel et al. (2023)."""
    degrees = survey.region.area / 3600
    rows = []
    for name, frame in objects.items():
        published = survey.instruments[name].publication
        stars = joined[name]["star"].to_numpy(bool)
        for population, count in (("galaxies", int((~stars).sum())), ("stars", int(stars.sum()))):
            paper = (
                None if published is None else {"galaxies": published.galaxies, "stars": published.stars}[population]
            )
            rows.append(
                (f"{name}: detected {population} / deg2", f"{count / degrees:,.0f}", f"{paper:,.0f}" if paper else "")
            )
        rows.append((f"{name}: flagged objects", f"{(frame['flags'] != 0).mean():.1%}" if len(frame) else "", ""))
        for band in survey.bands(name):
            paper = None if published is None else published.depths.get(band)
            rows.append(
                (
                    f"{band}: 5-sigma depth, AB mag",
                    f"{depth[band]:.2f}" if np.isfinite(depth[band]) else "",
                    f"{paper:.1f}" if paper else "",
                )
            )
    return table_of(pd.DataFrame(rows, columns=["", "here", "Troxel et al. 2023"]))


def _lensing(survey: Survey) -> str:
    tables = {name: survey.shear(name) for name in survey.instruments}
    tables = {name: table for name, table in tables.items() if len(table)}
    if not tables:
        return ""
    rows = [
        {
            "survey": name,
            "galaxies": f"{table['galaxies'].iloc[0]:,}",
            "galaxies / arcmin2": f"{table['galaxies'].iloc[0] / survey.region.area:.1f}",
            "rms of a component": f"{table['sigma'].iloc[0]:.3f}",
            "signal to noise": f"{significance(table):.1f}",
        }
        for name, table in tables.items()
    ]
    return (
        "<h2>Cosmic shear</h2>"
        + table_of(pd.DataFrame(rows))
        + "<p>Troxel et al. (2023), the whole survey: 69 galaxies a square arcminute, 0.247, signal to noise 47.</p>"
        + image_of(
            figures.shear(tables),
            "Two-point functions of the true shapes of detected galaxies, with errors from the Gaussian covariance. "
            "Lines: prediction of the input cosmology for the redshifts of the sample.",
        )
    )


def _run_statistics(survey: Survey) -> str:
    assert survey.store is not None
    table = pd.DataFrame(run_figures(survey.store))
    shown = pd.DataFrame(
        {
            "stage": table["stage"],
            "units": table["units"],
            "rows or pixels": table["rows"],
            "seconds of work": table["seconds"].map("{:.1f}".format),
            "MB uncompressed": (table["bytes"] / 1e6).map("{:.1f}".format),
            "peak worker GiB": (table["peak_bytes"] / 2**30).map("{:.2f}".format),
            "warnings": table["warnings"],
        }
    )
    disk = bytes_below(survey.store.root)
    versions = ", ".join(f"{name} {number}" for name, number in stored_versions(survey.store).items())
    return (
        "<h2>The run</h2>"
        + table_of(shown)
        + f"<p>On disk: {disk / 1e6:.0f} MB. Made with {html.escape(versions)}.</p>"
    )


def _busiest_tile(survey: Survey, objects: dict[str, pd.DataFrame]) -> int:
    """Return the number of the tile with the most detected objects."""
    names = [tile.name for tile in survey.tiles]
    counts = [frame["tile"].value_counts().reindex(names, fill_value=0).to_numpy() for frame in objects.values()]
    return int(np.argmax(np.sum(counts, axis=0)))
