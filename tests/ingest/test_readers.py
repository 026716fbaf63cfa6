"""Source catalogs of all formats come in one normal form, in bounded batches, with every row accounted for."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from romandask.ingest import instance_catalog, parquet, skycatalogs, table
from romandask.ingest.rows import COLUMNS, COMPONENTS, MAX_ROWS, Batch, merge_components
from romandask.model.errors import UserError


def everything(source) -> pd.DataFrame:
    return pd.concat([source.read(batch) for batch in source.batches()], ignore_index=True)


def same(first: pd.DataFrame, second: pd.DataFrame, *without: str) -> None:
    pd.testing.assert_frame_equal(first.drop(columns=list(without)), second.drop(columns=list(without)))


@pytest.fixture(scope="module")
def instances(shared) -> Path:
    return shared / "dc2_instance_catalog/example_instance_catalog.txt"


# skyCatalogs


def test_the_sample_reads_whole_and_good(shared):
    source = skycatalogs.open_source(shared / "skycatalogs_sample")
    frame = everything(source)
    assert tuple(frame) == COLUMNS
    assert frame["kind"].value_counts().to_dict() == {"galaxy": 2500, "star": 2487}
    assert len(frame) == source.count() == 4987
    assert (frame["reason"] == "").all()
    assert len({batch.name for batch in source.batches()}) == len(source.batches()) == 10
    assert source.cell(source.batches()[1]) == (5, 8633)
    assert len(source.edges) == 31
    assert source.edges[0] == 100.0
    raw = pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet").to_pandas()
    mine = frame[frame["source"] == "galaxy_9683.parquet"].reset_index(drop=True)
    for name in ("ra", "shear_2", "size_minor_disk_true", "position_angle_unlensed", "bulge_magnorm", "n_knots"):
        np.testing.assert_array_equal(mine[name], raw[name].astype(float))
    np.testing.assert_allclose(np.stack(mine["sed_val_knots"]), np.stack(raw["sed_val_knots"]), rtol=1e-6)
    assert (mine["bulge_av"] == 0).all()
    assert np.isinf(mine["knots_magnorm"]).any()
    stars = frame[frame["kind"] == "star"]
    assert stars[["redshift", "bulge_magnorm", "size_disk_true"]].isna().all(axis=None)
    assert stars["sed"].str.startswith("starSED/").all()


def test_fluxes_are_joined_by_id_whatever_their_order(shared, tmp_path):
    straight = everything(skycatalogs.open_source(shared / "skycatalogs_sample"))
    copy_sample(shared, tmp_path, lambda frame: frame)
    flux = pq.read_table(shared / "skycatalogs_sample/galaxy_flux_9683.parquet").to_pandas()
    pq.write_table(pa.Table.from_pandas(flux.iloc[::-1].iloc[:400]), tmp_path / "galaxy_flux_9683.parquet")
    shuffled = everything(skycatalogs.open_source(tmp_path, rows=70))
    one = straight[straight["source"] == "galaxy_9683.parquet"].reset_index(drop=True)
    np.testing.assert_array_equal(shuffled["lsst_flux_i"][100:], one["lsst_flux_i"][100:])
    assert shuffled["lsst_flux_i"][:100].isna().all()
    np.testing.assert_array_equal(one["lsst_flux_i"], flux["lsst_flux_i"])


def test_slices_of_a_parquet_source_give_the_rows_of_one_batch(shared):
    whole = everything(skycatalogs.open_source(shared / "skycatalogs_sample"))
    source = skycatalogs.open_source(shared / "skycatalogs_sample", rows=37)
    parts = [source.read(batch) for batch in source.batches()]
    assert max(map(len, parts)) == 37
    same(pd.concat(parts, ignore_index=True), whole)


def copy_sample(shared, folder: Path, change, rows: int | None = None) -> Path:
    """The sample's galaxies of one pixel, changed, with the sample's configuration."""
    folder.mkdir(exist_ok=True)
    (folder / "skyCatalog.yaml").write_bytes((shared / "skycatalogs_sample/skyCatalog.yaml").read_bytes())
    frame = change(pq.read_table(shared / "skycatalogs_sample/galaxy_9683.parquet").to_pandas())
    pq.write_table(pa.Table.from_pandas(frame), folder / "galaxy_9683.parquet", row_group_size=rows)
    return folder


def test_bad_galaxies_are_set_aside_with_their_reason(shared, tmp_path):
    spoiled = {
        "position": ("ra", np.nan),
        "position ": ("dec", 91.0),
        "redshift": ("redshift", -0.1),
        "weak regime": ("convergence", 1.2),
        "weak regime ": ("shear_1", np.nan),
        "size": ("size_disk_true", -1),
        "minor axis": ("size_minor_disk_true", 50),
        "position angle": ("position_angle_unlensed", np.nan),
        "A_v": ("MW_av", np.nan),
        "R_v": ("MW_rv", 0.5),
        "Sersic": ("sersic_disk", 2.5),
    }

    def spoil(frame):
        for row, (name, value) in enumerate(spoiled.values()):
            frame.loc[row, name] = value
        frame.loc[21, "galaxy_id"] = frame.loc[20, "galaxy_id"]
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
    frame = everything(skycatalogs.open_source(tmp_path))
    raw = pq.read_table(tmp_path / "galaxy_9683.parquet").to_pandas()
    for row, word in enumerate(spoiled):
        assert word.strip() in frame["reason"][row]
    assert frame["reason"][20:25].tolist() == [
        "",
        "duplicate galaxy_id",
        "spectrum has a wrong number of bins",
        "no component has light",
        "id is missing, negative or not an integer",
    ]
    row = np.flatnonzero(np.isfinite(raw["knots_magnorm"]) & (raw["n_knots"] == 0))[0]
    assert frame["reason"][row] == "knots have light but no number"
    row = np.flatnonzero(raw["n_knots"].isna())[0]
    assert (frame["reason"][row], frame["n_knots"][row], frame["knots_magnorm"][row]) == ("", 0, np.inf)
    row = np.flatnonzero(raw["bulge_magnorm"].isna() & raw["size_bulge_true"].isna())[0]
    assert (frame["reason"][row], frame["bulge_magnorm"][row]) == ("", np.inf)
    assert (frame["reason"] != "").sum() == len(spoiled) + 5
    same(everything(skycatalogs.open_source(tmp_path, rows=7)), frame)


def test_the_generation_with_ellipticities_and_included_configuration(shared, tmp_path):
    """Schema 1.5: no position angle; ids of stars are text; the configuration in files of the object types."""
    kept = {}

    def change(frame):
        kept["angle"] = frame.pop("position_angle_unlensed")
        for component in ("disk", "bulge"):
            ratio = frame[f"size_minor_{component}_true"] / frame[f"size_{component}_true"]
            # ellipticity (1 - q) / (1 + q) at the position angle, as GCR gives it
            for index, wave in ((1, np.cos), (2, np.sin)):
                value = (1 - ratio) / (1 + ratio) * wave(2 * np.radians(kept["angle"]))
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
    frame = everything(source)
    galaxies, points = (frame[frame["kind"] == kind].reset_index(drop=True) for kind in ("galaxy", "star"))
    turn = galaxies["position_angle_unlensed"][1:] - kept["angle"][1:]
    np.testing.assert_allclose((turn + 90) % 180 - 90, 0, atol=1e-4)
    assert galaxies["reason"][0] == "bulge and disk differ in position angle"
    assert (galaxies["reason"][1:] == "spectrum has a wrong number of bins").all(), "the configuration has two bins"
    assert points["id"][0] == int(stars["id"][0])
    assert points["reason"][3:9].tolist() == [
        "id is missing, negative or not an integer",
        "object_type is not star",
        "magnorm is not a number",
        "no spectrum is named",
        "",
        "duplicate id",
    ]
    (tmp_path / "star_1.3.0.yaml").unlink()
    with pytest.raises(UserError, match=r"includes star_1\.3\.0\.yaml, which is not there"):
        skycatalogs.open_source(tmp_path)


def test_galaxies_with_named_spectra_and_the_early_sign_of_shear(shared, tmp_path):
    def change(frame):
        frame["shear_2_phosim"] = -frame.pop("shear_2")
        frame = frame.drop(columns=[f"sed_val_{c}" for c in COMPONENTS])
        frame.loc[2, "disk_sed_file_path"] = None
        return frame

    copy_sample(shared, tmp_path, change)
    raw = pq.read_table(tmp_path / "galaxy_9683.parquet").to_pandas()
    source = skycatalogs.open_source(tmp_path)
    frame = everything(source)
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
    frame = everything(skycatalogs.open_source(tmp_path))
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


def test_mistakes_in_a_skycatalogs_folder_are_named_at_opening(shared, tmp_path):
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


def test_a_damaged_page_is_told_and_large_row_groups_come_in_pieces(tmp_path):
    path = tmp_path / "t.parquet"
    frame = pd.DataFrame({"id": np.arange(50_000), "x": np.random.default_rng(1).normal(size=50_000)})
    pq.write_table(pa.Table.from_pandas(frame), path, row_group_size=50_000, write_page_checksum=True)
    got = parquet.read(path, ["x", "id"], 30_001, 45_000)
    np.testing.assert_array_equal(got["id"].to_numpy(), np.arange(30_001, 45_000))
    assert max(len(chunk) for chunk in got["id"].chunks) <= parquet.CHUNK
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"t\.parquet: cannot be read"):
        parquet.read(path, ["x", "id"], 0, 50_000)


# instance catalogs


def test_every_object_of_the_sample_is_read_and_components_become_galaxies(instances):
    source = instance_catalog.open_source(instances)
    frame = everything(source)
    assert source.count() == len(frame) == 1998
    assert (frame["kind"] == "star").sum() == 998
    assert frame.loc[frame["reason"] != "", "reason"].tolist() == ["no component has light"] * 3, "magnorm above 50"
    merged = merge_components(frame)
    assert merged["n_rows"].value_counts().to_dict() == {1: 1994, 2: 2}
    good = merged["reason"] == ""
    assert merged.loc[good, "n_rows"].sum() + (~good).sum() == 1998
    both = merged[merged["n_rows"] == 2]
    assert np.isfinite(both[["bulge_magnorm", "disk_magnorm"]]).all(axis=None)
    assert instance_catalog.read_header(instances)["obshistid"] == 398414
    assert instance_catalog.read_header(instances)["rotskypos"] == pytest.approx(131.235062)


def test_signs_units_and_components_are_those_of_an_independent_parse(instances):
    frame = everything(instance_catalog.open_source(instances)).set_index("row")
    lines = instances.read_text().splitlines()
    chosen = [n for n, line in enumerate(lines) if "sersic2d" in line][:40]
    seen = set()
    for number in chosen:
        words, row = lines[number].split(), frame.loc[number]
        part, code = {"4": ("bulge", 97), "1": ("disk", 107)}[words[16]]
        other = {"bulge": "disk", "disk": "bulge"}[part]
        seen.add(part)
        assert int(words[1]) == 1024 * row["id"] + code
        assert [row["shear_1"], row["shear_2"], row["convergence"]] == [
            float(words[7]),
            -float(words[8]),
            float(words[9]),
        ]
        assert row["position_angle_unlensed"] == pytest.approx((360 - float(words[15])) % 180)
        assert row[f"size_{part}_true"] == float(words[13])
        assert row[f"size_minor_{part}_true"] == float(words[14])
        assert row[f"{part}_sed"] == words[5]
        assert row[f"{part}_av"] == float(words[18])
        assert row[f"{part}_rv"] == float(words[19])
        assert row["MW_av"] == float(words[21])
        assert row[f"{other}_magnorm"] == np.inf
    assert seen == {"bulge", "disk"}


def test_blocks_of_text_give_the_rows_of_one_batch_plain_and_packed(instances, tmp_path):
    whole = everything(instance_catalog.open_source(instances))
    small = instance_catalog.open_source(instances, block=1500)
    parts = [small.read(batch) for batch in small.batches()]
    assert len(parts) > 250
    same(pd.concat(parts, ignore_index=True), whole)
    assert small.count() == 1998
    packed = tmp_path / "cat.txt.gz"
    packed.write_bytes(gzip.compress(instances.read_bytes()))
    unpacked = instance_catalog.open_source(packed, block=50_000)
    same(everything(unpacked), whole, "source")
    backwards = [unpacked.read(batch) for batch in unpacked.batches()[::-1]]
    same(pd.concat(backwards[::-1], ignore_index=True), whole, "source")
    packed.write_bytes(packed.read_bytes()[:20_000])
    with pytest.raises(UserError, match=r"cat\.txt\.gz: cannot be read .*: copy it again"):
        instance_catalog.open_source(packed)


POINT = "object 4 10.0 -5.0 20.0 starSED/a.gz 0 0 0 0 0 0 point none CCM 0.1 3.1"
SERSIC = (
    "object {id} 10.0 -5.0 22.0 galaxySED/b.gz 0.5 0.01 0.02 0.03 0 0 sersic2d 0.5 0.4 30 {n} CCM 0.1 3.1 CCM 0.1 3.1"
)
KNOTS = "object {id} 10.0 -5.0 23.0 galaxySED/c.gz 0.5 0.01 0.02 0.03 0 0 knots 0.5 0.4 30 25 CCM 0.1 3.1 CCM 0.1 3.1"
BULGE, DISK, KNOTS = (
    SERSIC.format(id=7 * 1024 + 97, n=4),
    SERSIC.format(id=7 * 1024 + 107, n=1),
    KNOTS.format(id=7 * 1024 + 127),
)


def written(path: Path, *lines: str) -> instance_catalog.Source:
    path.write_text("\n".join(lines) + "\n")
    return instance_catalog.open_source(path)


def test_broken_lines_are_set_aside_and_accounted_for(tmp_path):
    broken = {
        "object 5 10.0": "too few fields (3)",
        POINT.removesuffix(" 3.1"): "too few fields (16)",
        POINT + " 7": "too many fields (18, expected 17)",
        POINT.replace("10.0", "ten"): "ra is not a number",
        POINT.replace("10.0", "nan"): "position is not a number",
        POINT.replace("-5.0", "-95.0"): "position is not a number",
        POINT.replace("object 4", "object four"): "id is missing, negative or not an integer",
        POINT.replace("20.0", "nan"): "magnorm is not a number",
        POINT.replace("20.0", "99"): "magnorm of 50 or more: no light",
        POINT.replace(".gz 0 0", ".gz 0.7 0"): "point source with a redshift is no star",
        POINT.replace("point", "gauss"): "shape 'gauss' is not known",
        POINT.replace("CCM 0.1 3.1", "CCM 0.1 0.3"): "R_v below 1",
        POINT.replace("CCM", "calzetti"): "law 'calzetti' of galactic dust is not known",
        DISK.replace("CCM 0.1 3.1 CCM", "CCM 0.1 0.9 CCM"): "R_v below 1",
        DISK.replace("30 1 CCM", "30 2.5 CCM"): "Sersic index 2.5 is neither 1 nor 4",
        DISK.replace("0.5 0.4", "-0.5 0.4"): "size is negative or not a number",
        DISK.replace("0.5 0.4", "0.4 0.5"): "minor axis above the major axis",
        DISK.replace("gz 0.5", "gz -0.5"): "redshift is not a number",
        DISK.replace("0.02 0.03", "0.02 1.03"): "shear or convergence beyond the weak regime",
        DISK.replace(" 30 ", " nan "): "position angle is not a number",
        DISK.replace("22.0", "inf"): "no component has light",
        KNOTS.replace("30 25", "30 0"): "knots have light but no number",
        "objct 4 5 6": "line is neither a header, an includeobj nor an object",
    }
    source = written(tmp_path / "cat.txt", "obshistid 7", "# a remark", "", POINT, *broken)
    frame = everything(source)
    assert source.count() == len(frame) == len(broken) + 1
    assert frame["row"].tolist() == list(range(3, 4 + len(broken)))
    assert dict(zip(broken, frame["reason"][1:], strict=True)) == broken
    assert frame["reason"][0] == ""
    assert (frame["id"] == -1).sum() == 2
    merged = merge_components(frame)
    good = merged["reason"] == ""
    assert merged.loc[good, "n_rows"].sum() + (~good).sum() == len(frame)


def test_components_merge_and_conflicts_are_set_aside(tmp_path):
    def line(template: str, number: int, old: str = "", new: str = "") -> str:
        code = int(template.split()[1]) % 1024
        text = " ".join(["object", str(number * 1024 + code), *template.split()[2:]])
        assert not old or old in text
        return text.replace(old, new) if old else text

    lines = [
        line(KNOTS, 1),
        line(BULGE, 1, "22.0", "21.0"),
        line(DISK, 1, "-5.0", "-5.00001"),
        line(BULGE, 2),
        line(DISK, 2, "-5.0", "-5.0001"),
        line(BULGE, 3),
        line(DISK, 3, "gz 0.5", "gz 0.6"),
        line(BULGE, 4),
        line(BULGE, 4),
        line(DISK, 4),
        line(BULGE, 5),
        line(DISK, 5, " 30 ", " 31 "),
        line(DISK, 6),
        line(KNOTS, 6, "0.5 0.4", "0.6 0.4"),
        line(KNOTS, 8),
        line(BULGE, 8),
        POINT,
        POINT,
        line(BULGE, 9),
        line(DISK, 9, "0.02 0.03", "0.03 0.03"),
    ]
    frame = everything(written(tmp_path / "cat.txt", *lines))
    assert (frame["reason"] == "").all()
    merged = merge_components(frame)
    galaxies = merged[(merged["reason"] == "") & (merged["kind"] == "galaxy")].set_index("id")
    assert galaxies["n_rows"].to_dict() == {1: 3, 4: 2, 8: 2}
    one = galaxies.loc[1]
    assert (one["bulge_magnorm"], one["disk_magnorm"], one["knots_magnorm"], one["n_knots"]) == (21, 22, 23, 25)
    assert (one["bulge_sed"], one["knots_sed"]) == ("galaxySED/b.gz", "galaxySED/c.gz")
    assert (one["size_bulge_true"], one["size_minor_disk_true"], one["disk_av"], one["shear_2"]) == (
        0.5,
        0.4,
        0.1,
        -0.02,
    )
    assert galaxies.loc[8, "size_disk_true"] == 0.5, "knots without a disk keep its shape"
    bad = merged[merged["reason"] != ""]
    assert bad.groupby("reason").size().to_dict() == {
        "components of one id lie apart": 2,
        "components of one id differ in redshift": 2,
        "a component of this galaxy is listed twice": 1,
        "components of one id differ in position angle": 2,
        "disk and knots differ in size": 2,
        "duplicate id": 1,
        "components of one id differ in lensing": 2,
    }
    assert merged.loc[merged["reason"] == "", "n_rows"].sum() + len(bad) == len(lines)
    same(merge_components(merge_components(frame).drop(columns="n_rows")), merged, "n_rows")


def test_included_files_are_read_and_missing_ones_told(tmp_path):
    (tmp_path / "sub").mkdir()
    with gzip.open(tmp_path / "sub/gal.txt.gz", "wt") as file:
        file.write(BULGE + "\n" + DISK)
    source = written(tmp_path / "cat.txt", "obshistid 9", "includeobj sub/gal.txt.gz", POINT)
    frame = everything(source)
    assert frame["source"].tolist() == ["cat.txt", "sub/gal.txt.gz", "sub/gal.txt.gz"]
    assert frame["row"].tolist() == [2, 0, 1]
    names = [batch.name for batch in source.batches()]
    assert len(set(names)) == 2
    assert not any("/" in name for name in names)
    assert merge_components(frame)["n_rows"].tolist() == [1, 2]
    with pytest.raises(UserError, match=r"cat\.txt: includes star\.txt, which is not beside it"):
        written(tmp_path / "cat.txt", "includeobj star.txt", POINT)
    with pytest.raises(UserError, match="holds no line 'object"):
        written(tmp_path / "cat.txt", "obshistid 9")
    with pytest.raises(UserError, match="no such file"):
        instance_catalog.open_source(tmp_path / "none.txt")
    (tmp_path / "binary").write_bytes(b"\x00\x01" * 100)
    with pytest.raises(UserError, match="not text"):
        instance_catalog.open_source(tmp_path / "binary")


def test_batches_of_a_large_text_are_bounded(instances, tmp_path):
    lines = [line for line in instances.read_text().splitlines(keepends=True) if line.startswith("object")]
    path = tmp_path / "large.txt"
    with open(path, "w") as file:
        for _ in range(150):
            file.writelines(lines)
    source = instance_catalog.open_source(path)
    batches = source.batches()
    assert source.count() == 150 * 1998
    assert len(batches) > 3
    last = source.read(batches[-1])
    assert 0 < len(last) <= MAX_ROWS
    assert last["row"].iloc[-1] == source.count() - 1
    first = source.read(batches[0])
    assert 50_000 < len(first) <= MAX_ROWS
    following = source.read(Batch(path, source.block, source.block + 1000, batches[1].key))
    assert following["row"].iloc[0] == len(first)


# tables

MAP = {
    "id": "gid",
    "ra": "RA",
    "dec": "DEC",
    "redshift": "z",
    "disk_magnorm": "m",
    "size_disk_true": "hlr",
    "disk_sed": "spectrum",
    "MW_rv": 3.1,
    "lsst_flux_i": "fi",
}


def galaxies(count: int = 1000) -> pd.DataFrame:
    rng = np.random.default_rng(3)
    frame = pd.DataFrame(
        {
            "gid": np.arange(count) + 2**60,
            "RA": rng.uniform(0, 360, count),
            "DEC": rng.uniform(-90, 90, count),
            "z": rng.uniform(0, 2, count).astype(np.float32),
            "m": rng.uniform(20, 25, count),
            "hlr": 0.3,
            "spectrum": "b.sed  ",
            "fi": 1.0,
        }
    )
    frame.loc[3, "RA"] = np.nan
    frame.loc[700, "gid"] = frame.loc[2, "gid"]
    frame.loc[5, "hlr"] = -1
    return frame


def test_parquet_and_fits_tables_of_the_same_content_are_the_same_frame(tmp_path):
    frame = galaxies()
    pq.write_table(pa.Table.from_pandas(frame), tmp_path / "t.parquet", row_group_size=300)
    Table.from_pandas(frame).write(tmp_path / "t.fits")
    first = everything(table.open_source(tmp_path / "t.parquet", MAP, "galaxy"))
    second = everything(table.open_source(tmp_path / "t.fits", MAP, "galaxy"))
    same(first, second, "source")
    for name in ("t.parquet", "t.fits"):
        source = table.open_source(tmp_path / name, MAP, "galaxy", rows=64)
        same(everything(source), first, "source")
        assert source.count() == 1000
    assert first["reason"][[2, 3, 5, 700]].tolist() == [
        "",
        "position is not a number",
        "size is negative or not a number",
        "duplicate galaxy_id",
    ]
    assert (first["reason"] != "").sum() == 3
    assert first["id"][0] == 2**60
    assert (first["disk_sed"] == "b.sed").all()
    assert first["size_minor_disk_true"][0] == first["size_disk_true"][0]
    assert (first[["MW_rv", "MW_av", "shear_1", "bulge_magnorm"]].iloc[0] == [3.1, 0, 0, np.inf]).all()
    (tmp_path / "folder/Norder=1").mkdir(parents=True)
    (tmp_path / "folder/_metadata.parquet").write_bytes(b"")
    for part in (0, 1):
        rows = frame.iloc[500 * part : 500 * (part + 1)]
        pq.write_table(pa.Table.from_pandas(rows), tmp_path / f"folder/Norder=1/Npix={part}.parquet")
    parts = table.open_source(tmp_path / "folder", MAP, "galaxy")
    assert len({batch.name for batch in parts.batches()}) == 2
    np.testing.assert_array_equal(everything(parts)["ra"], first["ra"])


def test_stars_of_a_table_may_have_a_magnitude_and_one_spectrum(tmp_path):
    frame = pd.DataFrame({"id": ["17", "18", "x"], "ra": [1.0, 2, 3], "dec": 0.0, "i": [20.0, np.nan, 21]})
    pq.write_table(pa.Table.from_pandas(frame), tmp_path / "s.parquet")
    columns = {"id": "id", "ra": "ra", "dec": "dec", "sed": "=blackbody_5800", "ref_mag": "i", "ref_band": "=lsst_i"}
    got = everything(table.open_source(tmp_path / "s.parquet", columns, "star"))
    assert got["id"].tolist() == [17, 18, -1]
    assert got["sed"].tolist() == ["blackbody_5800"] * 3
    assert got["reason"].tolist() == ["", "magnorm is not a number", "id is missing, negative or not an integer"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shear1": "m"}, r"names 'shear1', which romandask does not have: meant 'shear_1'\?"),
        ({"redshift": None}, r"of a galaxy lacks redshift \(found gid, RA"),
        ({"disk_magnorm": None}, "lacks one of bulge_magnorm, disk_magnorm, knots_magnorm"),
        ({"disk_sed": None, "size_disk_true": None}, "lacks size_disk_true; disk_sed"),
        ({"knots_magnorm": "m"}, "lacks n_knots"),
        ({"ra": "Ra"}, r"column 'Ra' \(for ra\) is missing \(found .*\); meant 'RA'\?"),
        ({"ra": "spectrum"}, r"column 'spectrum' \(for ra\) holds text: expected number"),
        ({"disk_sed": "m"}, r"column 'm' \(for disk_sed\) holds number: expected text"),
        ({"disk_sed": 3}, "gives disk_sed as 3: expected a name after ="),
        ({"ra": "=x"}, "gives ra as '=x': expected a number"),
    ],
)
def test_mistakes_in_a_column_map_are_named_at_opening(tmp_path, change, message):
    pq.write_table(pa.Table.from_pandas(galaxies(10)), tmp_path / "t.parquet")
    columns = {name: value for name, value in (MAP | change).items() if value is not None}
    with pytest.raises(UserError, match=message):
        table.open_source(tmp_path / "t.parquet", columns, "galaxy")


def test_files_that_are_no_table_are_told(tmp_path):
    Table.from_pandas(galaxies()).write(tmp_path / "t.fits")
    whole = (tmp_path / "t.fits").read_bytes()
    (tmp_path / "t.fits").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"t\.fits: not a complete FITS file"):
        table.open_source(tmp_path / "t.fits", MAP, "galaxy")
    (tmp_path / "t.fits.gz").write_bytes(gzip.compress(whole))
    with pytest.raises(UserError, match=r"neither a Parquet nor a FITS file .*: unpack it"):
        table.open_source(tmp_path / "t.fits.gz", MAP, "galaxy")
    with pytest.raises(UserError, match="no such file or folder"):
        table.open_source(tmp_path / "none", MAP, "galaxy")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"holds no \.parquet file"):
        table.open_source(tmp_path / "empty", MAP, "galaxy")
    with pytest.raises(UserError, match="kind 'quasar' is not known"):
        table.open_source(tmp_path, MAP, "quasar")
