"""Property tests: any value in a catalog is used or quarantined with a reason, and any setting is used or refused."""

import warnings
from contextlib import suppress

import numpy as np
import pandas as pd
import pytest
import yaml
from conftest import ROOT
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.model.errors import UserError
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region
from romandask.pipeline import load_pipeline
from romandask.stages.truth.catalogs import truth

REGION = Region(53.0, 53.1, -40.1, -40.0)
BANDS = {band: Rubin(RubinSettings()).bandpass(band) for band in "gi"}
GALAXY = {
    "ra": 53.05,
    "dec": -40.05,
    "redshift": 1.0,
    "position_angle_unlensed": 10.0,
    "n_knots": 3.0,
    "disk_magnorm": 24.0,
    "bulge_magnorm": 25.0,
    "knots_magnorm": 26.0,
    "size_disk_true": 1.0,
    "size_minor_disk_true": 0.5,
    "size_bulge_true": 1.0,
    "size_minor_bulge_true": 0.5,
    "shear_1": 0.01,
    "shear_2": 0.0,
    "convergence": 0.0,
    "disk_av": 0.1,
    "disk_rv": 3.1,
    "bulge_av": 0.1,
    "bulge_rv": 3.1,
    "MW_av": 0.1,
    "MW_rv": 3.1,
}
STAR = {"ra": 53.05, "dec": -40.05, "magnorm": 20.0, "MW_av": 0.1, "MW_rv": 3.1}
SPECTRA = st.sampled_from(["flat"] * 8 + ["none", "", "../flat"])
NUMBERS = st.floats() | st.sampled_from([0.0, -0.0, 99.0, -99.0, 1e4, -1e4, 1e30, -1e30, 1e300, -1e300, 1e-300])
PIPELINE = yaml.safe_load((ROOT / "pipelines" / "tiny.yaml").read_text())


def catalogs(good, spectra):
    """Return tables of up to ten good rows with up to two arbitrary numbers in each; some ids occur twice."""
    odd = st.dictionaries(st.sampled_from(sorted(good)), NUMBERS, max_size=2)
    row = st.builds(
        lambda found, names, number: {**good, **found, **names, "id": number},
        odd,
        st.fixed_dictionaries(dict.fromkeys(spectra, SPECTRA)),
        st.integers(-1, 60),
    )
    return st.lists(row, min_size=1, max_size=10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("any")
    wave = np.linspace(20, 3000, 3000)
    np.savetxt(folder / "flat", np.stack([wave, wave**-2.0], 1))
    return folder


def read(folder, kind, content):
    """Return the rows of the truth catalog of a table, and the input rows in the region that were not quarantined."""
    frame = pd.DataFrame(content)
    frame.to_parquet(folder / f"{kind}.parquet")
    table = {"path": f"{kind}.parquet", "columns": {name: name for name in frame}}
    asked = TruthSettings(source="table", order=6, seds=".", **{f"{kind}_table": table})
    with warnings.catch_warnings():
        # an overflow, for example, is an error
        warnings.simplefilter("error")
        found = truth(asked, folder, REGION, BANDS, 1)
        product = found.galaxies if kind == "galaxy" else found.stars
        parts = [product.make(k) for k in range(len(product.units))]
        quarantined = pd.concat([found.quarantine.make(k) for k in range(len(found.quarantine.units))])
    assert (quarantined["reason"] != "").all()
    assert not quarantined["row"].duplicated().any()
    good = frame.drop(frame.index[quarantined["row"].to_numpy(int)])
    expected = good[REGION.contains(good["ra"], good["dec"], asked.margin)]
    return pd.concat(parts) if parts else product.empty(), expected


def check(out, expected):
    """Check that the catalog has exactly the good rows, and finite fluxes that are not negative."""
    assert out["n_rows"].sum() == len(expected)
    np.testing.assert_array_equal(np.sort(out["ra"]), np.sort(expected["ra"] % 360))
    fluxes = out[[name for name in out if name.startswith("flux_")]].to_numpy(float)
    assert np.isfinite(fluxes).all()
    assert (fluxes >= 0).all()


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(catalogs(GALAXY, ["disk_sed", "bulge_sed", "knots_sed"]))
def test_any_catalog_of_galaxies(folder, content):
    out, expected = read(folder, "galaxy", content)
    assert not {-1} & set(expected["id"])
    assert not expected["id"].duplicated().any()
    check(out, expected)
    shapes = out[["size_disk_true", "size_minor_bulge_true", "shear_1", "convergence", "redshift", "disk_av", "MW_av"]]
    assert np.isfinite(shapes.to_numpy(float)).all()


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(catalogs(STAR, ["sed"]))
def test_any_catalog_of_stars(folder, content):
    out, expected = read(folder, "star", content)
    check(out, expected)


def paths(content, before=()):
    """Yield the keys of all settings, as paths."""
    for key, value in content.items():
        yield (*before, key)
        if isinstance(value, dict):
            yield from paths(value, (*before, key))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5) | st.integers(), inner, max_size=2),
    max_leaves=4,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(st.sampled_from(sorted(paths(PIPELINE))), VALUES, min_size=1, max_size=3))
def test_any_settings_are_taken_or_refused(folder, changes):
    content = yaml.safe_load(yaml.safe_dump(PIPELINE))
    for path, value in changes.items():
        section = content
        for key in path[:-1]:
            section = section.get(key) if isinstance(section, dict) else {}
        with suppress(TypeError):
            section[path[-1]] = value
    (folder / "p.yaml").write_text(yaml.safe_dump(content))
    try:
        found = load_pipeline(folder / "p.yaml")
    except UserError:
        return
    found.instruments()
    (folder / "again.yaml").write_text(found.to_yaml())
    assert load_pipeline(folder / "again.yaml") == found
