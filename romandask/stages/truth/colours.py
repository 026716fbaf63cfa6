"""How much the colours of TRILEGAL stars, which are drawn as blackbodies, differ from the magnitudes of their files."""

from __future__ import annotations

import numpy as np

from romandask.ingest.skycatalogs import Source
from romandask.ingest.skycatalogs_rows import TRILEGAL_BANDS
from romandask.ingest.spectra import BLACKBODY, blackbodies
from romandask.kernels.universe.dust import Dust, no_dust
from romandask.kernels.universe.synthetic_photometry import band_photons, njy
from romandask.model.spectra import Bandpass, LibrarySpectra, ab_magnitude
from romandask.products.tables import TableProduct
from romandask.stages.truth.ingested import sources_of

SAMPLE_ROWS = 10_000
"""Number of stars that are compared."""


def colour_note(rows: TableProduct, bandpasses: dict[str, Bandpass]) -> str:
    """Return a line on the difference between the magnitudes of TRILEGAL stars, as drawn and in their files.

    Parameters
    ----------
    rows : TableProduct
        Ingested rows.
    bandpasses : dict of str to Bandpass
        Bandpasses of the survey, by band; those named u, g, r, i, z and y are compared.

    Returns
    -------
    str
        The line; "" if there are no such stars, or no magnitudes besides the one that is kept.
    """
    for source in sources_of(rows):
        if isinstance(source, Source) and (found := _differences(source, bandpasses)):
            listed = ", ".join(
                f"{band} {np.median(values):+.2f} ({values.min():+.2f} to {values.max():+.2f})"
                for band, values in found.items()
            )
            return (
                "TRILEGAL stars are drawn as blackbodies of their effective temperature: drawn minus catalog "
                f"magnitude, median and range: {listed}"
            )
    return ""


def _differences(source: Source, bandpasses: dict[str, Bandpass]) -> dict[str, np.ndarray]:
    """Return the drawn minus the catalog magnitudes of a sample of TRILEGAL stars, by band."""
    stars = source.trilegal_sample(SAMPLE_ROWS)
    bands = [band for band in "ugrizy" if f"{band}mag" in stars and band in bandpasses]
    if not len(stars) or len(bands) < 2:
        return {}
    reference = next(band for band in TRILEGAL_BANDS if band in bands)
    names = sorted(stars["sed"].unique())
    kelvin = [int(match[1]) for name in names if (match := BLACKBODY.fullmatch(name))]
    spectra = LibrarySpectra(blackbodies(tuple(kelvin)), np.searchsorted(names, stars["sed"].to_numpy(str)))
    dust = Dust(stars["MW_av"].to_numpy(float), stars["MW_rv"].to_numpy(float))
    zeros = np.zeros(len(stars))
    chosen = [bandpasses[band] for band in bands]
    photons = band_photons(zeros, spectra, zeros, no_dust(len(stars)), dust, tuple(chosen))[0]
    drawn = {band: ab_magnitude(njy(photons[:, k], chosen[k])) for k, band in enumerate(bands)}
    shift = stars[f"{reference}mag"].to_numpy(float) - drawn[reference]
    out = {band: drawn[band] + shift - stars[f"{band}mag"].to_numpy(float) for band in bands if band != reference}
    out = {band: values[np.isfinite(values)] for band, values in out.items()}
    return {band: values for band, values in out.items() if len(values)}
