"""skyCatalogs folders of all generations are read into the normal form, and every row is accounted for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from read_source import assert_same_rows, read_all

from romandask.ingest import skycatalogs
from romandask.ingest.rows import COLUMNS, COMPONENTS
from romandask.model.errors import UserError


def test_the_sample_is_read_completely_and_no_row_is_quarantined(shared):
    source = skycatalogs.open_source(shared / "skycatalogs_sample")
    frame = read_all(source)
    assert tuple(frame) == COLUMNS
    assert frame["kind"].value_counts().to_dict() == {"galaxy": 2500, "star": 2487}
    assert len(frame) == source.count() == 4987
    assert (frame["reason"] == "").all()
    assert len({batch.name for batch in source.batches()}) == len(source.batches()) == 10
    assert source.cell(source.batches()[1]) == (5, 8633)
    assert len(source.edges) == 31
    assert source.edges[0] == 100.0
    raw = pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet").to_pandas()
    galaxies = frame[frame["source"] == "galaxy_9683.parquet"].reset_index(drop=True)
    for name in ("ra", "shear_2", "size_minor_disk_true", "position_angle_unlensed", "bulge_magnorm", "n_knots"):
        np.testing.assert_array_equal(galaxies[name], raw[name].astype(float))
    np.testing.assert_allclose(np.stack(galaxies["sed_val_knots"]), np.stack(raw["sed_val_knots"]), rtol=1e-6)
    assert (galaxies["bulge_av"] == 0).all()
    assert np.isinf(galaxies["knots_magnorm"]).any()
    stars = frame[frame["kind"] == "star"]
    assert stars[["redshift", "bulge_magnorm", "size_disk_true"]].isna().all(axis=None)
    assert stars["sed"].str.startswith("starSED/").all()


def test_fluxes_are_joined_by_id_in_any_order(shared, tmp_path):
    original = read_all(skycatalogs.open_source(shared / "skycatalogs_sample"))
    copy_sample(shared, tmp_path, lambda frame: frame)
    flux = pq.read_table(shared / "skycatalogs_sample/galaxy_flux_9683.parquet").to_pandas()
    pq.write_table(pa.Table.from_pandas(flux.iloc[::-1].iloc[:400]), tmp_path / "galaxy_flux_9683.parquet")
    shuffled = read_all(skycatalogs.open_source(tmp_path, rows=70))
    galaxies = original[original["source"] == "galaxy_9683.parquet"].reset_index(drop=True)
    np.testing.assert_array_equal(shuffled["lsst_flux_i"][100:], galaxies["lsst_flux_i"][100:])
    assert shuffled["lsst_flux_i"][:100].isna().all()
    np.testing.assert_array_equal(galaxies["lsst_flux_i"], flux["lsst_flux_i"])


def test_small_batches_give_the_same_rows_as_one_batch(shared):
    one_batch = read_all(skycatalogs.open_source(shared / "skycatalogs_sample"))
    source = skycatalogs.open_source(shared / "skycatalogs_sample", rows=37)
    batches = [source.read(batch) for batch in source.batches()]
    assert max(map(len, batches)) == 37
    assert_same_rows(pd.concat(batches, ignore_index=True), one_batch)


def copy_sample(shared, folder: Path, change, rows: int | None = None) -> Path:
    """Write the sample's galaxies of one pixel, modified by `change`, and its configuration to a folder."""
    folder.mkdir(exist_ok=True)
    (folder / "skyCatalog.yaml").write_bytes((shared / "skycatalogs_sample/skyCatalog.yaml").read_bytes())
    frame = change(pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet").to_pandas())
    pq.write_table(pa.Table.from_pandas(frame), folder / "galaxy_9683.parquet", row_group_size=rows)
    return folder


def test_bad_galaxies_are_quarantined_with_a_reason(shared, tmp_path):
    bad_values = [
        ("ra", np.nan, "position"),
        ("dec", 91.0, "declination"),
        ("redshift", -0.1, "redshift"),
        ("convergence", 1.2, "weak regime"),
        ("shear_1", np.nan, "weak regime"),
        ("size_disk_true", -1, "size"),
        ("size_minor_disk_true", 50, "minor axis"),
        ("position_angle_unlensed", np.nan, "position angle"),
        ("MW_av", np.nan, "A_v"),
        ("MW_rv", 0.5, "R_v"),
        ("sersic_disk", 2.5, "Sersic"),
    ]

    def spoil(frame):
        for row, (name, value, _) in enumerate(bad_values):
            frame.loc[row, name] = value
        frame.at[22, "sed_val_disk"] = frame.loc[22, "sed_val_disk"][:5]
        frame.loc[23, [f"{c}_magnorm" for c in COMPONENTS]] = [np.nan, np.inf, np.nan]
        frame.loc[24, "galaxy_id"] = -5
        lit = np.flatnonzero(np.isfinite(frame["knots_magnorm"]))
        frame.loc[lit[-1], "n_knots"] = 0
        dark = np.flatnonzero(np.isinf(frame["knots_magnorm"]))
        frame.loc[dark[-1], ["n_knots", "knots_magnorm"]] = np.nan
        frame.loc[dark[-2], ["bulge_magnorm", "size_bulge_true"]] = np.nan
        return frame

    copy_sample(shared, tmp_path, spoil, rows=100)
    frame = read_all(skycatalogs.open_source(tmp_path))
    raw = pq.read_table(tmp_path / "galaxy_9683.parquet").to_pandas()
    for row, (_, _, expected) in enumerate(bad_values):
        assert expected in frame["reason"][row]
    assert frame["reason"][21:25].tolist() == [
        "",
        "spectrum has a wrong number of bins",
        "no component has light",
        "id -5 is negative",
    ]
    row = np.flatnonzero(np.isfinite(raw["knots_magnorm"]) & (raw["n_knots"] == 0))[0]
    assert frame["reason"][row] == "knots have light but no number"
    row = np.flatnonzero(raw["n_knots"].isna())[0]
    assert (frame["reason"][row], frame["n_knots"][row], frame["knots_magnorm"][row]) == ("", 0, np.inf)
    row = np.flatnonzero(raw["bulge_magnorm"].isna() & raw["size_bulge_true"].isna())[0]
    assert (frame["reason"][row], frame["bulge_magnorm"][row]) == ("", np.inf)
    assert (frame["reason"] != "").sum() == len(bad_values) + 4
    assert_same_rows(read_all(skycatalogs.open_source(tmp_path, rows=7)), frame)


def test_schema_1_5_has_ellipticities_and_included_configuration_files(shared, tmp_path):
    """Schema 1.5 has no position angle, identifiers of stars are text, and object types have configuration files."""
    removed = {}

    def change(frame):
        removed["angle"] = frame.pop("position_angle_unlensed")
        for component in ("disk", "bulge"):
            ratio = frame[f"size_minor_{component}_true"] / frame[f"size_{component}_true"]
            # ellipticity (1 - q) / (1 + q) at the position angle, as GCR gives it
            for index, wave in ((1, np.cos), (2, np.sin)):
                value = (1 - ratio) / (1 + ratio) * wave(2 * np.radians(removed["angle"]))
                frame[f"ellipticity_{index}_{component}_true"] = value
        frame.loc[0, ["ellipticity_1_disk_true", "ellipticity_1_bulge_true", "bulge_magnorm"]] = [0.3, -0.3, 24.0]
        return frame.drop(columns=["bulge_sed_file_path", "disk_sed_file_path"])

    copy_sample(shared, tmp_path, change)
    stars = pq.read_table(shared / "skycatalogs_sample/pointsource_9683.parquet").to_pandas()
    stars["id"] = stars["id"].astype(str)
    stars.loc[3, "id"] = "MS_10195_1375"
    stars.loc[4, "object_type"] = "sncosmo"
    stars.loc[5, "magnorm"] = np.nan
    stars.loc[6, "sed_filepath"] = None
    stars.loc[8, "id"] = stars.loc[7, "id"]
    pq.write_table(pa.Table.from_pandas(stars), tmp_path / "pointsource_9683.parquet")
    (tmp_path / "skyCatalog.yaml").unlink()
    bins = "[[1000, 246], [1246, 306]]"
    (tmp_path / "top_1.3.0.yaml").write_text(
        "object_types:\n  galaxy: !include galaxy_1.3.0.yaml\n  star: !include star_1.3.0.yaml\n  gaia_star: {}\n"
    )
    part = "area_partition: {nside: 64, ordering: ring, type: healpix}\n"
    (tmp_path / "galaxy_1.3.0.yaml").write_text(
        part + rf"file_template: galaxy_(?P<healpix>\d+).parquet{chr(10)}tophat: {{units: angstrom, bins: {bins}}}"
    )
    (tmp_path / "star_1.3.0.yaml").write_text(part + r"file_template: pointsource_(?P<healpix>\d+).parquet")
    source = skycatalogs.open_source(tmp_path)
    assert source.edges == pytest.approx((100, 124.6, 155.2))
    assert source.ignored == ("gaia_star",)
    assert source.cell(source.batches()[0])[0] == 6
    frame = read_all(source)
    galaxies, points = (frame[frame["kind"] == kind].reset_index(drop=True) for kind in ("galaxy", "star"))
    turn = galaxies["position_angle_unlensed"][1:] - removed["angle"][1:]
    np.testing.assert_allclose((turn + 90) % 180 - 90, 0, atol=1e-4)
    assert galaxies["reason"][0] == "bulge and disk differ in position angle"
    assert (galaxies["reason"][1:] == "spectrum has a wrong number of bins").all(), "the configuration has two bins"
    assert points["id"][0] == int(stars["id"][0])
    assert points["reason"][3:9].tolist() == [
        "id 'MS_10195_1375' is not an integer",
        "object_type is not star",
        "magnorm is not a number",
        "no spectrum is named",
        "",
        "",
    ]
    (tmp_path / "star_1.3.0.yaml").unlink()
    with pytest.raises(UserError, match=r"includes star_1\.3\.0\.yaml, which is not there"):
        skycatalogs.open_source(tmp_path)


def test_galaxies_with_named_spectra_and_the_early_sign_of_shear_2(shared, tmp_path):
    def change(frame):
        frame["shear_2_phosim"] = -frame.pop("shear_2")
        frame = frame.drop(columns=[f"sed_val_{c}" for c in COMPONENTS])
        frame.loc[2, "disk_sed_file_path"] = None
        return frame

    copy_sample(shared, tmp_path, change)
    raw = pq.read_table(tmp_path / "galaxy_9683.parquet").to_pandas()
    source = skycatalogs.open_source(tmp_path)
    frame = read_all(source)
    assert source.edges == ()
    np.testing.assert_array_equal(frame["shear_2"], -raw["shear_2_phosim"])
    assert frame["bulge_sed"][0] == raw["bulge_sed_file_path"][0]
    assert (frame["knots_sed"] == frame["disk_sed"]).all()
    assert frame["reason"].tolist() == ["", "", "no spectrum is named"] + [""] * 497
    assert set(frame["sed_val_disk"].map(len)) == {0}


def test_trilegal_stars_are_blackbodies_with_a_magnitude(tmp_path):
    (tmp_path / "skyCatalog.yaml").write_text(
        r"object_types: {trilegal: {file_template: 'trilegal_(?P<healpix>\d+).parquet'}}"
    )
    for pixel in (9683, 9684):
        frame = pd.DataFrame(
            {
                "id": [f"lsst_sim.simdr2_hp{pixel}_{n}" for n in range(5)],
                "ra": 55.0 + np.arange(5),
                "dec": -35.0,
                "av": 0.1,
                "logT": np.log10([5772, 3449, 12345, 1e-9, 4000.0]),
                "logg": 4.4,
                "logL": 0.0,
                "Z": 0.02,
                "imag": [20.0, 21, 22, 23, np.nan],
                "rmag": 19.0,
            }
        )
        pq.write_table(pa.Table.from_pandas(frame), tmp_path / f"trilegal_{pixel}.parquet")
    frame = read_all(skycatalogs.open_source(tmp_path))
    assert frame["sed"][:3].tolist() == ["blackbody_5800", "blackbody_3400", "blackbody_12300"]
    assert frame["reason"][:5].tolist() == [
        "",
        "",
        "",
        "effective temperature is not a number",
        "magnorm is not a number",
    ]
    assert frame["magnorm"].isna().all()
    assert frame["ref_mag"][:3].tolist() == [20, 21, 22]
    assert (frame["ref_band"] == "lsst_i").all()
    assert (frame["MW_av"] == 0.1).all()
    assert frame["id"].is_unique
    (tmp_path / "trilegal_9684.parquet").unlink()
    pq.write_table(pa.Table.from_pandas(pd.DataFrame({"id": ["a"], "ra": [1.0]})), tmp_path / "trilegal_9684.parquet")
    with pytest.raises(UserError, match=r"trilegal_9684\.parquet: column 'dec' is missing"):
        skycatalogs.open_source(tmp_path)


def test_opening_a_folder_reports_mistakes_in_it(shared, tmp_path):
    folder = copy_sample(shared, tmp_path / "s", lambda frame: frame.drop(columns="shear_2"))
    with pytest.raises(UserError, match=r"galaxy_9683\.parquet: column 'shear_2' is missing"):
        skycatalogs.open_source(folder)
    path = folder / "galaxy_9683.parquet"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(UserError, match=r"galaxy_9683\.parquet: not a complete Parquet file \(5000 bytes\)"):
        skycatalogs.open_source(folder)
    path.rename(folder / "galaxy_99999.parquet")
    with pytest.raises(UserError, match="not a HEALPix pixel of nside 32"):
        skycatalogs.open_source(folder)
    (folder / "galaxy_99999.parquet").rename(folder / "diffsky_galaxy_9683.parquet")
    with pytest.raises(UserError, match="holds no galaxy_<pixel>"):
        skycatalogs.open_source(folder)
    (folder / "skyCatalog.yaml").unlink()
    with pytest.raises(UserError, match=r"holds no skyCatalog\.yaml"):
        skycatalogs.open_source(folder)
    with pytest.raises(UserError, match="no such folder"):
        skycatalogs.open_source(tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("ra", lambda column: column.astype(str), "column 'ra' holds text: expected number"),
        (
            "galaxy_id",
            lambda column: column.astype(float) + 0.5,
            r"column 'galaxy_id' \(for id\) holds .* 64-bit float",
        ),
        ("sed_val_disk", lambda column: column.map(len), "column 'sed_val_disk' holds number: expected lists"),
    ],
)
def test_a_column_of_the_wrong_type_is_refused(shared, tmp_path, name, change, words):
    copy_sample(shared, tmp_path, lambda frame: frame.assign(**{name: change(frame[name])}))
    with pytest.raises(UserError, match=words):
        skycatalogs.open_source(tmp_path)


def test_a_flux_file_with_texts_is_refused(shared, tmp_path):
    copy_sample(shared, tmp_path, lambda frame: frame)
    fluxes = pq.read_table(shared / "skycatalogs_sample/galaxy_flux_9683.parquet").to_pandas()
    fluxes["lsst_flux_g"] = "none"
    fluxes.to_parquet(tmp_path / "galaxy_flux_9683.parquet")
    with pytest.raises(UserError, match=r"galaxy_flux_9683\.parquet: column 'lsst_flux_g' holds text: expected number"):
        skycatalogs.open_source(tmp_path)


def test_a_byte_order_mark_in_a_configuration_is_left_out(shared, tmp_path):
    copy_sample(shared, tmp_path, lambda frame: frame)
    path = tmp_path / "skyCatalog.yaml"
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert skycatalogs.open_source(tmp_path).count() == 500


def test_units_of_columns_are_converted(shared, tmp_path):
    copy_sample(shared, tmp_path, lambda frame: frame.assign(ra=np.radians(frame["ra"])))
    path = tmp_path / "galaxy_9683.parquet"
    content = pq.read_table(path)
    number = content.column_names.index("ra")
    pq.write_table(
        content.set_column(number, pa.field("ra", pa.float64(), metadata={"unit": "rad"}), content["ra"]), path
    )
    expected = pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet")["ra"].to_numpy()
    np.testing.assert_allclose(read_all(skycatalogs.open_source(tmp_path))["ra"], expected, rtol=1e-12)


def test_top_hat_spectra_that_cannot_be_used_are_quarantined(shared, tmp_path):
    values = {
        0: (3, np.nan),
        1: (3, np.inf),
        2: (3, -1e-3),
        3: (slice(None), 0.0),
        4: (slice(10, 20), 0.0),
        5: (29, 0.0),
    }

    def change(frame):
        lit = np.flatnonzero(np.isfinite(frame["disk_magnorm"]))
        dark = np.flatnonzero(~np.isfinite(frame["bulge_magnorm"]))
        for row, (place, value) in values.items():
            frame.at[lit[row], "sed_val_disk"] = frame.at[lit[row], "sed_val_disk"].copy()
            frame.at[lit[row], "sed_val_disk"][place] = value
        frame.at[dark[-1], "sed_val_bulge"] = np.full(30, np.nan)
        return frame.assign(lit=np.isfinite(frame["disk_magnorm"]))

    copy_sample(shared, tmp_path, change)
    frame = read_all(skycatalogs.open_source(tmp_path))
    lit = pq.read_table(tmp_path / "galaxy_9683.parquet")["lit"].to_numpy()
    no_light = "spectrum has no light at 500 nm, where magnorm is defined"
    nan = "spectrum holds NaN or infinite values"
    assert frame["reason"][lit].tolist()[:6] == [nan, nan, "spectrum is negative somewhere", no_light, no_light, ""]
    assert (frame["reason"] != "").sum() == 5, "the spectrum of a component without light does not matter"


def test_a_type_that_the_configuration_does_not_name_is_told(shared):
    with pytest.raises(UserError, match=r"object_types names .*, not trilegal, but the folder holds trilegal_9812"):
        skycatalogs.open_source(shared / "odd_inputs/sky/trilegal_not_in_config")
    with pytest.raises(UserError, match="column 'ra' holds text"):
        skycatalogs.open_source(shared / "odd_inputs/sky/badra")
