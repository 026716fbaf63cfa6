"""How well a survey's objects are measured, against the truth: depths, and residuals of magnitudes by magnitude."""

from __future__ import annotations

import numpy as np
import pandas as pd

from romandask.model.spectra import ab_magnitude

FAINT_SNR = 10.0
"""Signal to noise in a band below which the noise of an object is the sky's."""
EDGES = np.arange(16.0, 28.01, 0.5)
"""Bins of true magnitude."""


def depths(objects: pd.DataFrame, bands: tuple[str, ...]) -> pd.Series:
    """Return the 5-sigma depth of point sources, AB mag by band: of five times the median error of faint PSF fluxes.

    Parameters
    ----------
    objects : <band>_psfFlux and <band>_psfFluxErr, nJy
    """
    found = {}
    for band in bands:
        flux, error = (objects[f"{band}_{name}"].to_numpy(float) for name in ("psfFlux", "psfFluxErr"))
        faint = error[(error > 0) & (flux < FAINT_SNR * error)]
        found[band] = float(ab_magnitude(5 * np.median(faint))) if len(faint) else np.nan
    return pd.Series(found, name="depth", dtype=float)


def with_truth(objects: pd.DataFrame, matched: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Return objects that have a counterpart in the truth's summary, each beside it (flux_<band>, star, redshift).

    Parameters
    ----------
    objects, matched, summary : tables objects, truth_match and truth_summary of a survey
    """
    true = summary.drop(columns=["objectId", "separation", "objects", "ra", "dec"])
    pairs = matched.loc[matched["truth_id"] >= 0, ["objectId", "truth_id", "star", "candidates"]]
    return objects.merge(pairs, on="objectId").merge(true, on=["truth_id", "star"])


def colours_of(joined: pd.DataFrame, first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
    """Return true and measured (Kron) colours of objects with a signal to noise above ten in both bands."""
    bright = np.ones(len(joined), bool)
    for band in (first, second):
        bright &= (joined[f"{band}_kronFlux"] > FAINT_SNR * joined[f"{band}_kronFluxErr"]).to_numpy()
    chosen = joined[bright]
    true, measured = (
        ab_magnitude(chosen[name.format(first)]) - ab_magnitude(chosen[name.format(second)])
        for name in ("flux_{}", "{}_kronFlux")
    )
    return true, measured


def residuals(joined: pd.DataFrame, bands: tuple[str, ...], flux: str = "kronFlux") -> pd.DataFrame:
    """Return, by band and bin of true magnitude, how measured magnitudes differ from the true ones.

    Parameters
    ----------
    joined : what `with_truth` returns
    flux : kronFlux, apFlux or psfFlux

    Returns
    -------
    Columns band, magnitude (middle of the bin), objects; bias and scatter of measured less true magnitudes (median,
    1.48 of the median absolute deviation); pull and pull_scatter, the same of (measured - true) / error of the flux;
    flagged, the share of objects with any flag. Of bias, scatter and pulls flagged objects are left out.
    """
    rows = []
    for band in bands:
        true, value = joined[f"flux_{band}"].to_numpy(float), joined[f"{band}_{flux}"].to_numpy(float)
        error = joined[f"{band}_{flux}Err"].to_numpy(float)
        place = np.digitize(ab_magnitude(true), EDGES) - 1
        with np.errstate(divide="ignore", invalid="ignore"):
            # a flux that is not positive is fainter than any other: left out, the faint side would be cut off
            magnitude = np.where(value <= 0, np.inf, ab_magnitude(value))
            difference, pull = magnitude - ab_magnitude(true), (value - true) / error
        clean = joined["flags"].to_numpy() == 0
        for k in range(len(EDGES) - 1):
            here = place == k
            if not here.any():
                continue
            offsets = _centre(difference[here & clean]) + _centre(pull[here & clean])
            flagged = 1 - clean[here].mean()
            rows.append((band, (EDGES[k] + EDGES[k + 1]) / 2, int(here.sum()), *offsets, float(flagged)))
    names = ["band", "magnitude", "objects", "bias", "scatter", "pull", "pull_scatter", "flagged"]
    return pd.DataFrame(rows, columns=names)


def _centre(values: np.ndarray) -> tuple[float, float]:
    """Return the median and 1.48 of the median absolute deviation of what is a number."""
    values = values[~np.isnan(values)]
    if not len(values):
        return np.nan, np.nan
    middle = float(np.median(values))
    if not np.isfinite(middle):
        return np.nan, np.nan
    return middle, float(1.4826 * np.median(np.abs(values - middle)))
