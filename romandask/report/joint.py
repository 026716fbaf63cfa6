"""The report's sections on both surveys together: blends, one field in all bands, difference images."""

from __future__ import annotations

import html

import numpy as np
import pandas as pd

from romandask.report import figures, joint_figures
from romandask.report.html import image_of, table_of
from romandask.stages.analysis.friends_of_friends import length_name
from romandask.stages.coadds.tile_maker import tile_maker, unit_of
from romandask.survey import Survey

FIELD = 12.0
"""Half the side of the field that is shown in all bands, arcsec."""
SHOWN = 60.0
"""Half the side of the difference that is shown, arcsec."""


def blends(survey: Survey) -> str:
    """Return the groups of both surveys' objects and the blends among them."""
    if not _joint(survey):
        return ""
    lengths, statistics = survey.pipeline.matches.linking_lengths, survey.statistics
    rows = {name: len(survey.output(f"samples/{name}").column("objectId")) for name in survey.instruments}
    limits = [survey.output(f"limits/{name}").load(0).iloc[0] for name in survey.instruments]
    cuts = ", ".join(f"{row['band']} < {row['limit']:.2f}" for row in limits if np.isfinite(row["limit"]))
    kind = "unflagged, with a true counterpart" if survey.pipeline.matches.sample == "clean" else "all objects"
    text = (
        f"<h2>Blends</h2><p>Friends of friends over {rows['roman']} objects of Roman and {rows['rubin']} of Rubin: "
        f"{kind}{', ' + html.escape(cuts) if cuts else ''}. An unrecognised blend is alone of Rubin in a group with "
        "two or more objects of Roman.</p>"
    )
    for length in lengths:
        counts = statistics.blends(length)
        if counts.size:
            text += image_of(
                figures.blend_matrix(counts, length),
                f"Numbers of groups at a linking length of {length:g} arcsec. Rows: Roman, columns: Rubin.",
            )
    tables = {length: statistics.unrecognised(length) for length in lengths}
    chance = {length: statistics.chance(length) for length in lengths}
    return (
        text
        + table_of(pd.DataFrame([_blend_row(survey, length, tables[length], chance[length]) for length in lengths]))
        + "<p>Troxel et al. (2023): 20 to 30% of Rubin's detections are unrecognised blends; 12% of the groups have a "
        "Rubin object and none of Roman, 95% of those within a magnitude of the limit. A blend is real where its Roman "
        "objects are two or more true ones, the second with a twentieth of the light or more. By chance: the share of "
        "Rubin objects that have a Roman one, or two, where all of Rubin's are moved.</p>"
        + image_of(
            figures.blend_fraction(tables, chance),
            "Unrecognised blends against i magnitude; errors are binomial. Dotted: objects with any Roman object by "
            "chance.",
        )
        + image_of(
            figures.blend_distributions(statistics.distributions(lengths[0])),
            f"Rubin's objects alone of their survey in a group ({lengths[0]:g} arcsec), with one Roman object and with "
            "more: colour to the brightest of them, and size.",
        )
    )


def _blend_row(survey: Survey, length: float, table: pd.DataFrame, chance: pd.DataFrame) -> dict[str, str]:
    """Return the figures of one linking length."""
    total, moved = table.sum(numeric_only=True), chance.sum(numeric_only=True)
    objects, blends = int(total["rubin_objects"]), int(total["blends"])
    counts = survey.statistics.blends(length)
    alone = int(counts.loc[0].drop(0, errors="ignore").sum()) if 0 in counts.index else 0
    faintest = float(survey.output("limits/rubin").load(0)["limit"].iloc[0])
    near = table.loc[table["i_mag_high"] > faintest - 1, "alone"].sum()

    def share(part: float, whole: float) -> str:
        return f"{part / whole:.1%}" if whole else ""

    return {
        "linking length": f"{length:g} arcsec",
        "unrecognised blends": f"{blends} of {objects}: {share(blends, objects)}",
        "of them real": share(total["real"], blends),
        "groups with Rubin alone": share(alone, counts.to_numpy().sum()),
        "within 1 mag of the limit": share(near, total["alone"]) if np.isfinite(faintest) else "",
        "one or more by chance": share(moved["with_roman"], moved["rubin_objects"]),
        "two or more by chance": share(moved["blends"], moved["rubin_objects"]),
    }


def field(survey: Survey, objects: dict[str, pd.DataFrame], tile: int) -> str:
    """Return the field of a tile with the most unrecognised blends, in all bands, the blends circled."""
    if not _joint(survey):
        return ""
    groups = _with_blends(survey)
    name = survey.tiles[tile].name
    ids = {key: set(frame.loc[frame["tile"] == name, "objectId"]) for key, frame in objects.items()}
    here = groups[[row.objectId in ids[row.survey] for row in groups.itertuples()]]
    if not len(here):
        return ""
    tiles = {key: survey.output(f"coadds/{key}") for key in survey.instruments}
    makers = {key: tile_maker(product) for key, product in tiles.items()}
    frames, images = {key: maker.wcs(tile) for key, maker in makers.items()}, {}
    x, y = frames["rubin"].all_world2pix(here["coord_ra"], here["coord_dec"], 0)
    scale = survey.instruments["rubin"].coadd_scale
    middle = _crowded(np.stack([x, y], axis=1) * scale, here["blend"].to_numpy(), FIELD)
    # the field lies within the tile
    extent = scale * makers["rubin"].pixels
    middle = np.clip(middle, min(FIELD + 1, extent / 2), max(extent - FIELD - 1, extent / 2))
    at = frames["rubin"].all_pix2world(*(middle[:, None] / scale), 0)
    for key, product in tiles.items():
        instrument = survey.instruments[key]
        u, v = (int(round(float(value[0]))) for value in frames[key].all_world2pix(*at, 0))
        count = int(FIELD / instrument.coadd_scale)
        side = makers[key].pixels
        window = tuple(slice(max(place - count, 0), min(place + count + 1, side)) for place in (v, u))
        images[key] = {
            band: product.load(unit_of(tile, band, instrument.bands), ("image",), window)["image"]
            for band in instrument.bands
        }
    marks = {
        key: here[here["survey"] == key].assign(
            x=x[here["survey"] == key] * scale - middle[0], y=y[here["survey"] == key] * scale - middle[1]
        )
        for key in survey.instruments
    }
    return "<h2>One field in every band</h2>" + image_of(
        joint_figures.field(images, FIELD, marks),
        f"The {2 * FIELD:g} arcsec of tile {name} with the most unrecognised blends. Large circles: objects of Rubin, "
        f"small ones: of Roman, both of the samples; red: one of Rubin that is two or more of Roman within "
        f"{survey.pipeline.matches.linking_lengths[0]:g} arcsec.",
    )


def _joint(survey: Survey) -> bool:
    return {"roman", "rubin"} <= set(survey.instruments)


def _with_blends(survey: Survey) -> pd.DataFrame:
    """Return the objects of all groups with `blend`: True in an unrecognised one, at the first linking length."""
    groups = survey.output("matches/groups").all_rows()
    number = groups[f"group_{length_name(survey.pipeline.matches.linking_lengths[0])}"]
    rubin = (groups["survey"] == "rubin").groupby(number).transform("sum")
    roman = (groups["survey"] == "roman").groupby(number).transform("sum")
    return groups.assign(blend=(rubin == 1) & (roman >= 2))


def _crowded(places: np.ndarray, blend: np.ndarray, half: float) -> np.ndarray:
    """Return the place, of those (n, 2) of objects in blends or of all, around which the most blended objects are."""
    chosen = places[blend] if blend.any() else places
    near = [int((np.abs(chosen - one).max(axis=1) < 0.8 * half).sum()) for one in chosen]
    return chosen[int(np.argmax(near))]


def difference_images(survey: Survey) -> str:
    """Return the differences of Rubin's tiles and Roman's: a picture of one, and what is left of all objects."""
    if not survey.differs:
        return ""
    product, settings = survey.output("differences/rubin"), survey.pipeline.differences
    tables = [product.load(k, ("residuals",))["residuals"] for k in range(len(product.units))]
    table = pd.concat(tables)
    if not len(table):
        return ""
    tile = int(np.argmax([len(one) for one in tables]))
    arrays = product.load(tile)
    science = survey.output("coadds/rubin").load(
        tile * len(survey.bands("rubin")) + survey.bands("rubin").index(settings.science), ("image",)
    )["image"]
    count = int(SHOWN / survey.instruments["rubin"].coadd_scale)
    middle = science.shape[0] // 2
    part = (slice(max(middle - count, 0), middle + count),) * 2
    seen = arrays["rms"] > 0
    sigma = arrays["difference"][seen] / arrays["rms"][seen]
    images = {
        f"Rubin {settings.science}": science[part],
        f"Roman {settings.template}, matched": arrays["template"][part],
        "difference": arrays["difference"][part],
    }
    offset = np.hypot(table["dx"], table["dy"])
    text = (
        f"<p>{len(table)} objects of S/N above {settings.min_snr:g}: median shifts {table['dx'].median():+.4f} and "
        f"{table['dy'].median():+.4f} pixels of {survey.instruments['rubin'].coadd_scale:g} arcsec, half of all within "
        f"{offset.median():.3f}; scatter of the light that is left {1.4826 * np.median(np.abs(table['share'])):.1%} of "
        f"theirs, for their colours; pixels over their rms: {1.4826 * np.median(np.abs(sigma)):.3f}.</p>"
    )
    return (
        "<h2>Difference images</h2>"
        + text
        + image_of(
            joint_figures.difference(images, sigma, table),
            f"The middle of tile {survey.tiles[tile].name}: what Rubin sees in {settings.science}, Roman's "
            f"{settings.template} with its PSF, and the difference; and by how much objects are off their places. The "
            "circle is a tenth of a pixel.",
        )
    )
