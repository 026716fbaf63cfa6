"""Sections of the report that combine both surveys: blends, one field in all bands, difference images."""

from __future__ import annotations

import html

import numpy as np
import pandas as pd

from romandask.report import joint_figures
from romandask.report.html import image_of, table_of
from romandask.stages.analysis.blend_pair import blend_pair, joint
from romandask.stages.analysis.friends_of_friends import length_name
from romandask.survey import Survey

FIELD_HALF_SIDE = 12.0
"""Half the side of the field that is shown in all bands, arcsec."""
DIFFERENCE_HALF_SIDE = 60.0
"""Half the side of the part of the difference image that is shown, arcsec."""


def blends(survey: Survey) -> str:
    """Return the section on unrecognised blends; empty for a survey of one telescope."""
    if not _joint(survey):
        return ""
    lengths, statistics = survey.pipeline.matches.linking_lengths, survey.statistics
    pair = survey.once(joint)
    names = pair.sharp, pair.blended
    sharp, blended = (survey.instruments[name].title for name in names)
    rows = [len(survey.output(f"samples/{name}").column("objectId")) for name in names]
    limits = [survey.output(f"limits/{name}").load(0).iloc[0] for name in names]
    cuts = ", ".join(f"{row['band']} < {row['limit']:.2f}" for row in limits if np.isfinite(row["limit"]))
    sample = "unflagged, with a true counterpart" if survey.pipeline.matches.sample == "clean" else "all objects"
    text = (
        f"<h2>Blends</h2><p>Friends of friends over {rows[0]} objects of {sharp} and {rows[1]} of {blended}: "
        f"{sample}{', ' + html.escape(cuts) if cuts else ''}. An unrecognised blend is a group of one "
        f"{blended} object and two or more {sharp} objects.</p>"
    )
    for length in lengths:
        counts = statistics.blends(length)
        if counts.size:
            text += image_of(
                joint_figures.blend_matrix(counts, length),
                f"Number of groups by their numbers of {sharp} objects (rows) and {blended} objects (columns), for a "
                f"linking length of {length:g} arcsec.",
            )
    tables = {length: statistics.unrecognised(length) for length in lengths}
    chance = {length: statistics.chance(length) for length in lengths}
    return (
        text
        + table_of(pd.DataFrame([_blend_row(survey, length, tables[length], chance[length]) for length in lengths]))
        + "<p>Troxel et al. (2023): 20 to 30% of the Rubin objects are unrecognised blends; 12% of the groups have "
        "a Rubin object and no Roman object, and 95% of those are within a magnitude of the limit. A blend is real if "
        "its Roman objects are two or more true objects and the second has a twentieth of the light or more. By "
        "chance: the fraction of Rubin objects with one, or two, Roman objects after Rubin objects were shifted.</p>"
        + image_of(
            joint_figures.blend_fraction(tables, chance),
            "Fraction of unrecognised blends by i magnitude, with binomial errors. Dotted: fraction of Rubin objects "
            "with a Roman object by chance.",
        )
        + image_of(
            joint_figures.blend_distributions(statistics.distributions(lengths[0])),
            f"Rubin objects that are the only one in their group ({lengths[0]:g} arcsec), with one Roman object and "
            "with more: colour relative to the brightest Roman object, and size.",
        )
    )


def _blend_row(survey: Survey, length: float, table: pd.DataFrame, chance: pd.DataFrame) -> dict[str, str]:
    """Return the table row of one linking length."""
    objects, blends = int(table["rubin_objects"].sum()), int(table["blends"].sum())
    moved_objects = chance["rubin_objects"].sum()
    counts = survey.statistics.blends(length)
    alone = int(counts.drop(columns=0, errors="ignore").loc[0].to_numpy().sum()) if 0 in counts.index else 0
    faintest = float(survey.output(f"limits/{survey.once(joint).blended}").load(0)["limit"].iloc[0])
    near = table.loc[table["i_mag_high"] > faintest - 1, "alone"].sum()

    def share(part: float, whole: float) -> str:
        return f"{part / whole:.1%}" if whole else ""

    return {
        "linking length": f"{length:g} arcsec",
        "unrecognised blends": f"{blends} of {objects}: {share(blends, objects)}",
        "of them real": share(table["real"].sum(), blends),
        "groups with Rubin alone": share(alone, counts.to_numpy().sum()),
        "within 1 mag of the limit": share(near, table["alone"].sum()) if np.isfinite(faintest) else "",
        "one or more by chance": share(chance["with_roman"].sum(), moved_objects),
        "two or more by chance": share(chance["blends"].sum(), moved_objects),
    }


def field(survey: Survey, objects: dict[str, pd.DataFrame], tile: int) -> str:
    """Return the section with the field of a tile that has the most unrecognised blends, in all bands.

    Parameters
    ----------
    survey : Survey
        The survey.
    objects : dict of DataFrame
        Detected objects by survey.
    tile : int
        Number of the tile.

    Returns
    -------
    str
        HTML; empty if the survey has one telescope or the tile has no objects in groups.
    """
    if not _joint(survey):
        return ""
    groups = _with_blends(survey)
    name = survey.tiles[tile].name
    ids = {key: set(frame.loc[frame["tile"] == name, "objectId"]) for key, frame in objects.items()}
    owned = [number in ids[key] for key, number in zip(groups["survey"], groups["objectId"], strict=True)]
    in_tile = groups[owned]
    if not len(in_tile):
        return ""
    pair = survey.once(joint)
    tiles = {key: survey.output(f"coadds/{key}") for key in survey.instruments}
    frames, images = {key: coadds.wcs(tile) for key, coadds in tiles.items()}, {}
    wide = frames[pair.blended]
    x, y = wide.all_world2pix(in_tile["coord_ra"], in_tile["coord_dec"], 0)
    scale = survey.instruments[pair.blended].coadd_scale
    middle = _densest_position(np.stack([x, y], axis=1) * scale, in_tile["blend"].to_numpy(), FIELD_HALF_SIDE)
    # the field must lie within the tile
    extent = scale * tiles[pair.blended].pixels
    margin = FIELD_HALF_SIDE + 1
    middle = np.clip(middle, min(margin, extent / 2), max(extent - FIELD_HALF_SIDE - 1, extent / 2))
    centre = wide.all_pix2world(*(middle[:, None] / scale), 0)
    for key, coadds in tiles.items():
        instrument = coadds.instrument
        u, v = (int(round(float(value[0]))) for value in frames[key].all_world2pix(*centre, 0))
        half = int(FIELD_HALF_SIDE / instrument.coadd_scale)
        side = coadds.pixels
        window = tuple(slice(max(pixel - half, 0), min(pixel + half + 1, side)) for pixel in (v, u))
        images[key] = {band: coadds.read(tile, band, ("image",), window)["image"] for band in instrument.bands}
    marks = {}
    for part, key in (("sharp", pair.sharp), ("blended", pair.blended)):
        own = (in_tile["survey"] == key).to_numpy()
        marks[part] = in_tile[own].assign(x=x[own] * scale - middle[0], y=y[own] * scale - middle[1])
    red_to_blue = {key: instrument.picture_bands for key, instrument in survey.instruments.items()}
    sharp, blended = (survey.instruments[key].title for key in (pair.sharp, pair.blended))
    return "<h2>One field in every band</h2>" + image_of(
        joint_figures.field(images, red_to_blue, FIELD_HALF_SIDE, marks),
        f"The field of {2 * FIELD_HALF_SIDE:g} arcsec in tile {name} with the most unrecognised blends. Large circles: "
        f"sample of {blended}; small circles: sample of {sharp}; red: {blended} objects with two or more {sharp} "
        f"objects in their group (linking length {survey.pipeline.matches.linking_lengths[0]:g} arcsec).",
    )


def _joint(survey: Survey) -> bool:
    """Return whether the survey has two telescopes whose objects are compared."""
    return survey.once(blend_pair) is not None


def _with_blends(survey: Survey) -> pd.DataFrame:
    """Return the grouped objects with the column `blend`: whether they are in an unrecognised blend.

    Groups are those of the first linking length.
    """
    groups = survey.output("matches/groups").all_rows()
    number = groups[f"group_{length_name(survey.pipeline.matches.linking_lengths[0])}"]
    pair = survey.once(joint)
    blended = (groups["survey"] == pair.blended).groupby(number).transform("sum")
    sharp = (groups["survey"] == pair.sharp).groupby(number).transform("sum")
    return groups.assign(blend=(blended == 1) & (sharp >= 2))


def _densest_position(positions: np.ndarray, blend: np.ndarray, half: float) -> np.ndarray:
    """Return the position of the blended object with the most blended objects around it.

    Parameters
    ----------
    positions : ndarray, shape (n, 2)
        Positions of the objects.
    blend : ndarray of bool, shape (n,)
        Whether each object is in a blend. If none is, all objects are used.
    half : float
        Half the side of the field, in the unit of the positions; objects within 0.8 of it are counted.
    """
    chosen = positions[blend] if blend.any() else positions
    near = [int((np.abs(chosen - position).max(axis=1) < 0.8 * half).sum()) for position in chosen]
    return chosen[int(np.argmax(near))]


def difference_images(survey: Survey) -> str:
    """Return the section on difference images: the tile with the most residuals, and statistics of all residuals."""
    if not survey.differs:
        return ""
    settings = survey.pipeline.differences
    name = next(key for key, value in survey.instruments.items() if settings.science in value.bands)
    instrument, product = survey.instruments[name], survey.output(f"differences/{name}")
    tables = [product.load(k, ("residuals",))["residuals"] for k in range(len(product.units))]
    table = pd.concat(tables)
    if not len(table):
        return ""
    tile = int(np.argmax([len(residuals) for residuals in tables]))
    arrays = product.load(tile)
    coadds = survey.output(f"coadds/{name}")
    science = coadds.read(tile, settings.science, ("image",))["image"]
    count = int(DIFFERENCE_HALF_SIDE / instrument.coadd_scale)
    middle = science.shape[0] // 2
    part = (slice(max(middle - count, 0), middle + count),) * 2
    covered = arrays["rms"] > 0
    sigma = arrays["difference"][covered] / arrays["rms"][covered]
    images = {
        f"{instrument.title} {settings.science}": science[part],
        f"{settings.template}, matched": arrays["template"][part],
        "difference": arrays["difference"][part],
    }
    offset = np.hypot(table["dx"], table["dy"])
    text = (
        f"<p>{len(table)} objects with S/N above {settings.min_snr:g}: median offsets {table['dx'].median():+.4f} and "
        f"{table['dy'].median():+.4f} pixels of {instrument.coadd_scale:g} arcsec, median distance "
        f"{offset.median():.3f}. Scatter of the residual flux: {1.4826 * np.median(np.abs(table['share'])):.1%} of the "
        "flux, because objects differ in colour. Scatter of the difference over its rms: "
        f"{1.4826 * np.median(np.abs(sigma)):.3f}.</p>"
    )
    return (
        "<h2>Difference images</h2>"
        + text
        + image_of(
            joint_figures.difference(images, sigma, table),
            f"The middle of tile {survey.tiles[tile].name}: {settings.science}, {settings.template} convolved "
            f"to the PSF of {settings.science}, and the difference; and the offsets of objects between the two images. "
            "The circle has a radius of a tenth of a pixel.",
        )
    )
