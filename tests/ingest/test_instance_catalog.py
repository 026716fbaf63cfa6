"""Instance catalogs are read into the normal form, and every line with an object is accounted for."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from read_source import assert_same_rows, read_all

from romandask.ingest import instance_catalog
from romandask.ingest.components import merge_components
from romandask.ingest.rows import MAX_ROWS, Batch
from romandask.model.errors import UserError


@pytest.fixture(scope="module")
def instances(shared) -> Path:
    return shared / "dc2_instance_catalog/example_instance_catalog.txt"


def test_every_object_of_the_sample_is_read_and_components_are_merged(instances):
    source = instance_catalog.open_source(instances)
    frame = read_all(source)
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


def test_signs_units_and_components_agree_with_an_independent_parser(instances):
    frame = read_all(instance_catalog.open_source(instances)).set_index("row")
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


def test_small_blocks_of_plain_and_gzip_text_give_the_same_rows_as_one_batch(instances, tmp_path):
    one_batch = read_all(instance_catalog.open_source(instances))
    small = instance_catalog.open_source(instances, block=1500)
    parts = [small.read(batch) for batch in small.batches()]
    assert len(parts) > 250
    assert_same_rows(pd.concat(parts, ignore_index=True), one_batch)
    assert small.count() == 1998
    path = tmp_path / "cat.txt.gz"
    path.write_bytes(gzip.compress(instances.read_bytes()))
    compressed = instance_catalog.open_source(path, block=50_000)
    assert_same_rows(read_all(compressed), one_batch, "source")
    backwards = [compressed.read(batch) for batch in compressed.batches()[::-1]]
    assert_same_rows(pd.concat(backwards[::-1], ignore_index=True), one_batch, "source")
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(UserError, match=r"cat\.txt\.gz: cannot be read .*: copy it again"):
        instance_catalog.open_source(path)


POINT = "object 4 10.0 -5.0 20.0 starSED/a.gz 0 0 0 0 0 0 point none CCM 0.1 3.1"
SERSIC_TEMPLATE = (
    "object {id} 10.0 -5.0 22.0 galaxySED/b.gz 0.5 0.01 0.02 0.03 0 0 sersic2d 0.5 0.4 30 {n} CCM 0.1 3.1 CCM 0.1 3.1"
)
KNOTS_TEMPLATE = (
    "object {id} 10.0 -5.0 23.0 galaxySED/c.gz 0.5 0.01 0.02 0.03 0 0 knots 0.5 0.4 30 25 CCM 0.1 3.1 CCM 0.1 3.1"
)
BULGE = SERSIC_TEMPLATE.format(id=7 * 1024 + 97, n=4)
DISK = SERSIC_TEMPLATE.format(id=7 * 1024 + 107, n=1)
KNOTS = KNOTS_TEMPLATE.format(id=7 * 1024 + 127)


def write_catalog(path: Path, *lines: str) -> instance_catalog.Source:
    """Write an instance catalog with the given lines and open it."""
    path.write_text("\n".join(lines) + "\n")
    return instance_catalog.open_source(path)


def test_broken_lines_are_quarantined_and_counted(tmp_path):
    broken = {
        "object 5 10.0": "too few fields (3)",
        POINT.removesuffix(" 3.1"): "too few fields (16)",
        POINT + " 7": "too many fields (18, expected 17)",
        POINT.replace("10.0", "ten"): "ra is not a number",
        POINT.replace("10.0", "nan"): "position is not a number",
        POINT.replace("-5.0", "-95.0"): "declination is beyond -90 to 90 degrees",
        POINT.replace("object 4", "object four"): "id 'four' is not an integer",
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
    source = write_catalog(tmp_path / "cat.txt", "obshistid 7", "# a remark", "", POINT, *broken)
    frame = read_all(source)
    assert source.count() == len(frame) == len(broken) + 1
    assert frame["row"].tolist() == list(range(3, 4 + len(broken)))
    assert dict(zip(broken, frame["reason"][1:], strict=True)) == broken
    assert frame["reason"][0] == ""
    assert (frame["id"] == -1).sum() == 2
    merged = merge_components(frame)
    good = merged["reason"] == ""
    assert merged.loc[good, "n_rows"].sum() + (~good).sum() == len(frame)


def test_components_are_merged_and_conflicting_ones_are_quarantined(tmp_path):
    def line(template: str, number: int, old: str = "", new: str = "") -> str:
        """Return the line of a component of galaxy `number`, with `old` replaced by `new`."""
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
    frame = read_all(write_catalog(tmp_path / "cat.txt", *lines))
    assert (frame["reason"] == "").all()
    merged = merge_components(frame)
    galaxies = merged[(merged["reason"] == "") & (merged["kind"] == "galaxy")].set_index("id")
    assert galaxies["n_rows"].to_dict() == {1: 3, 4: 2, 8: 2}
    merged_galaxy = galaxies.loc[1]
    expected = {
        "bulge_magnorm": 21,
        "disk_magnorm": 22,
        "knots_magnorm": 23,
        "n_knots": 25,
        "bulge_sed": "galaxySED/b.gz",
        "knots_sed": "galaxySED/c.gz",
        "size_bulge_true": 0.5,
        "size_minor_disk_true": 0.4,
        "disk_av": 0.1,
        "shear_2": -0.02,
    }
    assert merged_galaxy[list(expected)].to_dict() == expected
    assert galaxies.loc[8, "size_disk_true"] == 0.5, "knots without a disk keep their own shape"
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
    assert_same_rows(merge_components(merge_components(frame).drop(columns="n_rows")), merged, "n_rows")


def test_included_files_are_read_and_missing_ones_are_reported(tmp_path):
    (tmp_path / "sub").mkdir()
    with gzip.open(tmp_path / "sub/gal.txt.gz", "wt") as file:
        file.write(BULGE + "\n" + DISK)
    source = write_catalog(tmp_path / "cat.txt", "obshistid 9", "includeobj sub/gal.txt.gz", POINT)
    frame = read_all(source)
    assert frame["source"].tolist() == ["cat.txt", "sub/gal.txt.gz", "sub/gal.txt.gz"]
    assert frame["row"].tolist() == [2, 0, 1]
    names = [batch.name for batch in source.batches()]
    assert len(set(names)) == 2
    assert not any("/" in name for name in names)
    assert merge_components(frame)["n_rows"].tolist() == [1, 2]
    with pytest.raises(UserError, match=r"cat\.txt: includes star\.txt, which is not beside it"):
        write_catalog(tmp_path / "cat.txt", "includeobj star.txt", POINT)
    with pytest.raises(UserError, match="holds no line 'object"):
        write_catalog(tmp_path / "cat.txt", "obshistid 9")
    with pytest.raises(UserError, match="no such file"):
        instance_catalog.open_source(tmp_path / "none.txt")
    (tmp_path / "binary").write_bytes(b"\x00\x01" * 100)
    with pytest.raises(UserError, match="not text"):
        instance_catalog.open_source(tmp_path / "binary")


@pytest.mark.slow
def test_batches_of_a_large_file_have_a_bounded_number_of_rows(instances, tmp_path):
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


@pytest.mark.parametrize("block", [200, 1 << 20])
def test_a_byte_order_mark_is_left_out(tmp_path, block):
    text = "\n".join([POINT, BULGE, DISK, POINT.replace("object 4", "object 5")]) + "\n"
    (tmp_path / "plain.txt").write_text(text)
    (tmp_path / "bom.txt").write_text(text, encoding="utf-8-sig")
    (tmp_path / "bom.txt.gz").write_bytes(gzip.compress((tmp_path / "bom.txt").read_bytes()))
    plain = instance_catalog.open_source(tmp_path / "plain.txt")
    for name in ("bom.txt", "bom.txt.gz"):
        source = instance_catalog.open_source(tmp_path / name, block)
        assert source.count() == 4
        assert_same_rows(read_all(source), read_all(plain), "source")
    (tmp_path / "bom.txt").write_text("obshistid 9\n" + text, encoding="utf-8-sig")
    assert instance_catalog.read_header(tmp_path / "bom.txt") == {"obshistid": 9}


def test_codes_in_identifiers_are_decided_for_the_whole_catalog(tmp_path):
    def bulges(ids):
        return [SERSIC_TEMPLATE.format(id=number, n=4) for number in ids]

    plain = read_all(write_catalog(tmp_path / "plain.txt", *bulges(range(90, 110))))
    assert plain["id"].tolist() == list(range(90, 110))
    assert (plain["reason"] == "").all()
    (tmp_path / "more.txt").write_text("\n".join(bulges(range(30, 60))) + "\n")
    included = read_all(write_catalog(tmp_path / "cat.txt", "includeobj more.txt", *bulges([97, 1024 + 97])))
    assert included["id"].tolist() == [97, 1024 + 97, *range(30, 60)]
    coded = [1024 * number + 97 for number in range(30)]
    (tmp_path / "more.txt").write_text("\n".join(bulges([5, 7 * 1024 + 77])) + "\n")
    mixed = read_all(write_catalog(tmp_path / "cat.txt", "includeobj more.txt", *bulges(coded)))
    assert mixed["id"].tolist() == [*range(30), 5, 7]
    assert mixed["reason"].tolist() == [""] * 30 + ["id 5 lacks the code of bulge, which the catalog has elsewhere", ""]


def test_long_and_suffixed_identifiers_are_read(tmp_path, shared):
    names = ("5853498713190525696_bulge", "5853498713190525697_disk")
    lines = [SERSIC_TEMPLATE.format(id=name, n=n) for name, n in zip(names, (4, 1), strict=True)]
    assert read_all(write_catalog(tmp_path / "cat.txt", *lines))["id"].tolist() == [
        5853498713190525696,
        5853498713190525697,
    ]
    for name, rows in (("gaia.txt", 20), ("bom.txt", 60)):
        frame = read_all(instance_catalog.open_source(shared / "odd_inputs/instance" / name))
        assert len(frame) == rows
        assert (frame["reason"] == "").all()
