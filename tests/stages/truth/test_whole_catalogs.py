"""What only a whole source catalog can tell: identifiers that repeat over files and sky cells, and fluxes."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.model.settings import TruthSettings
from romandask.model.sky import Region
from romandask.stages.truth import ingested
from romandask.stages.truth.catalogs import truth
from romandask.stages.truth.colours import colour_note

BANDS = {band: Rubin(RubinSettings()).bandpass(band) for band in "gi"}
EVERYWHERE = Region(0, 360, -90, 90)
STAR = {"id": "id", "ra": "ra", "dec": "dec", "magnorm": "mag", "sed": "=blackbody_5800"}
POINT = "object {id} {ra} {dec} 20.0 blackbody_5800 0 0 0 0 0 0 point none CCM 0.1 3.1"
SERSIC = "object {id} {ra} {dec} 22.0 {sed} 0.5 0 0 0 0 0 sersic2d 0.5 0.4 30 {n} CCM 0.1 3.1 CCM 0.1 3.1"


def read(folder, **settings):
    """Return the galaxies, the stars and the quarantined rows of a source, after checking that no row is lost."""
    catalogs = truth(TruthSettings(order=5, seds=".", **settings), folder, EVERYWHERE, BANDS, 1)
    tables = galaxies, stars, bad = [t.all_rows() for t in (catalogs.galaxies, catalogs.stars, catalogs.quarantine)]
    assert galaxies["n_rows"].sum() + stars["n_rows"].sum() + len(bad) == ingested.source_rows(catalogs.ingested)
    for table in (galaxies, stars):
        assert np.isfinite(table[[name for name in table if name.startswith("flux_")]].to_numpy(float)).all()
    assert not bad.duplicated(["source", "row"]).any()
    return tables


def instance(folder, *lines):
    wave = np.linspace(20, 3000, 300)
    np.savetxt(folder / "flat", np.stack([wave, wave**-2.0], 1))
    (folder / "cat.txt").write_text("\n".join(lines) + "\n")
    return read(folder, source="instance_catalog", path="cat.txt")


def sersic(number, n, ra, dec=60.0, sed="flat"):
    return SERSIC.format(id=number * 1024 + {4: 97, 1: 107}[n], n=n, ra=ra, dec=dec, sed=sed)


@pytest.mark.parametrize("far", [0.0, 20.0])
def test_the_first_row_of_all_files_has_an_identifier(tmp_path, far):
    (tmp_path / "stars").mkdir()
    for part in range(3):
        rows = {"id": [1, 2, 3 + part, 2], "ra": 10.0 + far * part + np.arange(4) / 100, "dec": 0.0, "mag": 20.0 + part}
        frame = pd.DataFrame(rows)
        frame.loc[0, "ra"] = np.nan if part == 1 else frame.loc[0, "ra"]
        frame.to_parquet(tmp_path / f"stars/part{part}.parquet")
    _, stars, bad = read(tmp_path, source="table", star_table={"path": "stars", "columns": STAR})
    assert stars.sort_values("id")[["id", "magnorm"]].to_numpy().tolist() == [
        [1, 20],
        [2, 20],
        [3, 20],
        [4, 21],
        [5, 22],
    ]
    assert bad["reason"].value_counts().to_dict() == {"duplicate id": 6, "position is not a number": 1}


def test_a_galaxy_and_a_star_may_have_the_same_identifier(tmp_path):
    lines = [sersic(1, 4, 10.0), sersic(2, 4, 10.1), POINT.format(id=1, ra=50, dec=5), POINT.format(id=1, ra=80, dec=5)]
    galaxies, stars, bad = instance(tmp_path, *lines)
    assert sorted(galaxies["galaxy_id"]) == [1, 2]
    assert stars["ra"].tolist() == [50]
    assert bad[["row", "id", "reason"]].to_numpy().tolist() == [[3, 1, "duplicate id"]]


def test_components_are_merged_over_a_border_of_cells(tmp_path):
    galaxies, _, bad = instance(tmp_path, sersic(1, 1, 90.000005), sersic(1, 4, 89.999995), sersic(2, 4, 91.0))
    assert galaxies.set_index("galaxy_id")["n_rows"].to_dict() == {1: 2, 2: 1}
    assert galaxies.set_index("galaxy_id")["ra"][1] == 90.000005
    assert not len(bad)


def test_components_far_apart_are_quarantined_as_those_of_one_cell(tmp_path):
    lines = [sersic(1, 4, 10.0), sersic(1, 1, 50.0), sersic(2, 4, 10.0), sersic(2, 1, 10.001)]
    galaxies, _, bad = instance(tmp_path, *lines)
    assert not len(galaxies)
    assert bad["reason"].tolist() == ["components of one id lie apart"] * 4


def test_components_whose_first_one_is_lost_in_another_cell_are_quarantined(tmp_path):
    lines = [sersic(1, 4, 10.0, sed="none"), sersic(1, 1, 50.0), sersic(2, 4, 10.0, sed="none"), sersic(2, 1, 10.0)]
    galaxies, _, bad = instance(tmp_path, *lines)
    assert galaxies["galaxy_id"].tolist() == [2]
    assert bad.sort_values("row")["reason"].tolist() == [
        "SED not in the library",
        "the first component of this galaxy cannot be used",
        "SED not in the library",
    ]


def test_objects_without_finite_fluxes_are_quarantined(tmp_path, monkeypatch):
    original = ingested.flux_columns

    def spoiled(band, fluxes):
        columns = original(band, fluxes)
        columns[f"flux_{band}"][:1] = np.nan if band == "g" else columns[f"flux_{band}"][:1]
        return columns

    monkeypatch.setattr(ingested, "flux_columns", spoiled)
    lines = [
        sersic(1, 4, 10.0),
        sersic(1, 1, 10.0),
        POINT.format(id=5, ra=10, dec=60),
        POINT.format(id=6, ra=50, dec=5),
    ]
    galaxies, stars, bad = instance(tmp_path, *lines, POINT.format(id=7, ra=50, dec=5))
    assert len(galaxies) == 0
    assert stars["id"].tolist() == [7]
    assert bad["reason"].tolist() == ["flux is not a number"] * 4


def test_colours_of_trilegal_stars_are_compared_with_the_catalog(shared):
    rubin = {band: Rubin(RubinSettings()).bandpass(band) for band in "ugrizy"}
    settings = TruthSettings(source="skycatalogs", path="sky/trilegal_colours")
    rows = ingested.ingested_rows(ingested.open_sources(settings, shared / "odd_inputs"))
    note = colour_note(rows, rubin)
    assert "u -0.70 (-2.09 to +0.18)" in note
    assert "i " not in note.partition("range:")[2], "the magnitude in i is kept"
    assert colour_note(rows, {"H158": rubin["i"]}) == ""
    settings = TruthSettings(source="skycatalogs", path="sky/sedodd")
    assert not colour_note(ingested.ingested_rows(ingested.open_sources(settings, shared / "odd_inputs")), rubin)


def test_repeated_identifiers_of_the_samples_have_one_row(shared):
    folder = shared / "odd_inputs"
    for path, count in (("table/restart", 12), ("run/dup3", 2)):
        _, stars, bad = read(folder, source="table", star_table={"path": path, "columns": STAR})
        assert len(stars) == stars["id"].nunique() == count
        assert set(bad["reason"]) == {"duplicate id"}
    galaxies, _, bad = read(folder, source="skycatalogs", path="sky/dupfar")
    assert len(galaxies) == galaxies["galaxy_id"].nunique() == 40
    assert bad["reason"].tolist() == ["duplicate galaxy_id"] * 10
    assert bad["source"].unique().tolist() == ["galaxy_9813.parquet"]


def test_spectra_of_the_sample_that_cannot_be_used_are_quarantined(shared):
    galaxies, _, bad = read(shared / "odd_inputs", source="skycatalogs", path="sky/sedodd")
    assert len(galaxies) == 31
    assert bad["reason"].value_counts().to_dict() == {
        "spectrum holds NaN or infinite values": 4,
        "spectrum is negative somewhere": 2,
        "spectrum has no light at 500 nm, where magnorm is defined": 1,
        "spectrum has a wrong number of bins": 1,
        "no spectrum is named": 1,
    }
