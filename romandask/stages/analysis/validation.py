"""Validation of a survey's objects: depths, and residuals of measured against true magnitudes."""

from __future__ import annotations

import numpy as np
import pandas as pd

from romandask.model.spectra import ab_magnitude

FAINT_SNR = 10.0
"""Signal-to-noise ratio of a flux below which its noise is dominated by the sky."""
EDGES = np.arange(16.0, 28.01, 0.5)
"""Edges of the bins in true magnitude."""


def depths(objects: pd.DataFrame, bands: tuple[str, ...]) -> pd.Series:
    """Return the 5-sigma depth of point sources in each band.

    It is the AB magnitude of five times the median error of the PSF fluxes of faint objects.

    Parameters
    ----------
    objects : DataFrame
        Columns `<band>_psfFlux` and `<band>_psfFluxErr`, nJy.
    bands : tuple of str

    Returns
    -------
    Series
        AB mag, by band; NaN in a band without faint objects.
    """
    depth = {}
    for band in bands:
        flux, error = (objects[f"{band}_{name}"].to_numpy(float) for name in ("psfFlux", "psfFluxErr"))
        faint = error[(error > 0) & (flux < FAINT_SNR * error)]
        depth[band] = float(ab_magnitude(5 * np.median(faint))) if len(faint) else np.nan
    return pd.Series(depth, name="depth", dtype=float)


def with_truth(objects: pd.DataFrame, matched: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """Return the objects that have a counterpart in the truth summary, joined with it.

    Parameters
    ----------
    objects : DataFrame
        Objects of a survey (schema: catalogs/objects.yaml).
    matched : DataFrame
        Their counterparts (schema: catalogs/truth_match.yaml).
    summary : DataFrame
        True objects (schema: catalogs/truth_summary.yaml).

    Returns
    -------
    DataFrame
        The columns of `objects` and, of the counterpart, truth_id, star, candidates, redshift and flux_<band> (nJy).
    """
    true = summary.drop(columns=["objectId", "separation", "objects", "ra", "dec"])
    pairs = matched.loc[matched["truth_id"] >= 0, ["objectId", "truth_id", "star", "candidates"]]
    return objects.merge(pairs, on="objectId").merge(true, on=["truth_id", "star"])


def colours_of(joined: pd.DataFrame, first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours of objects whose Kron flux has a signal-to-noise ratio above 10 in both bands.

    Parameters
    ----------
    joined : DataFrame
        Objects and counterparts, as `with_truth` returns them.
    first, second : str
        Bands; colours are magnitudes in the first minus the second.

    Returns
    -------
    true, measured : ndarray, shape (n,), mag
    """
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
    """Return the differences of measured and true magnitudes, by band and bin of true magnitude.

    Parameters
    ----------
    joined : DataFrame
        Objects and counterparts, as `with_truth` returns them.
    bands : tuple of str
    flux : {"kronFlux", "apFlux", "psfFlux"}

    Returns
    -------
    DataFrame
        One row per band and bin with objects: `band`, `magnitude` (middle of the bin), `objects` (their number),
        `bias` and `scatter` of measured minus true magnitudes (median, and 1.48 times the median absolute deviation),
        `pull` and `pull_scatter` (the same of (measured - true) / error of the flux), and `flagged` (share of objects
        with any flag). Flagged objects are left out of bias, scatter and pulls.
    """
    rows = []
    for band in bands:
        true, value = joined[f"flux_{band}"].to_numpy(float), joined[f"{band}_{flux}"].to_numpy(float)
        error = joined[f"{band}_{flux}Err"].to_numpy(float)
        bin_index = np.digitize(ab_magnitude(true), EDGES) - 1
        with np.errstate(divide="ignore", invalid="ignore"):
            # a flux that is not positive counts as infinitely faint: leaving it out would bias the median
            magnitude = np.where(value <= 0, np.inf, ab_magnitude(value))
            difference, pull = magnitude - ab_magnitude(true), (value - true) / error
        clean = joined["flags"].to_numpy() == 0
        for k in range(len(EDGES) - 1):
            in_bin = bin_index == k
            if not in_bin.any():
                continue
            moments = _centre_and_scatter(difference[in_bin & clean]) + _centre_and_scatter(pull[in_bin & clean])
            flagged = 1 - clean[in_bin].mean()
            rows.append((band, (EDGES[k] + EDGES[k + 1]) / 2, int(in_bin.sum()), *moments, float(flagged)))
    names = ["band", "magnitude", "objects", "bias", "scatter", "pull", "pull_scatter", "flagged"]
    return pd.DataFrame(rows, columns=names)


def _centre_and_scatter(values: np.ndarray) -> tuple[float, float]:
    """Return the median and 1.48 times the median absolute deviation of the values that are not NaN."""
    values = values[~np.isnan(values)]
    if not len(values):
        return np.nan, np.nan
    centre = float(np.median(values))
    if not np.isfinite(centre):
        return np.nan, np.nan
    return centre, float(1.4826 * np.median(np.abs(values - centre)))
