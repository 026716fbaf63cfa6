"""Products and records of a store: what is written is read back, and damage is detected."""

import pickle
from dataclasses import replace
from pathlib import Path

import dask
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr

from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct, conform
from romandask.products.units import LazyUnits, Unit, names_of
from romandask.storage.arrays import Variable
from romandask.storage.manifest import Record, digest, read_record, write_record
from romandask.storage.paths import write_bytes
from romandask.storage.store import Store, read_parquet, write_parquet

PLANE = Variable("image", "float32", (64, 48), ("y", "x"), {"units": "nJy"})


def image_product(count: int) -> ImageProduct:
    """Return an image product of `count` units, each an image of random values."""

    def make(index):
        return {"image": np.random.default_rng(index).normal(size=(64, 48)).astype(np.float32)}

    units = tuple(Unit(f"u{k}", k) for k in range(count))
    names = np.array([f"u{k}" for k in range(count)], object)
    coordinates = {"exposure": (("exposure",), names, {})}
    return ImageProduct(
        stage="exposures/x",
        units=units,
        make=make,
        variables=(PLANE,),
        axes=("exposure",),
        lengths=(count,),
        coordinates=lambda: coordinates,
    )


TORN = (
    Variable("shards", "float32", (5000, 8), ("y", "x"), {}),
    Variable("planes", "int16", (2, 64, 48), ("plane", "y", "x"), {}),
    Variable("files", "float32", (1100, 8), ("y", "x"), {}, compress=False),
)


@pytest.mark.parametrize(
    "damage",
    [lambda content: content[: len(content) // 2], lambda content: b"", lambda content: b"\0" * len(content), None],
    ids=["truncated", "empty", "changed", "gone"],
)
def test_a_damaged_unit_is_written_again(tmp_path, damage):
    """Zarr reads a shard before it writes it, and would fail."""
    product = replace(
        image_product(2),
        make=lambda k: {v.name: np.random.default_rng(k).normal(size=v.shape) * 99 for v in TORN},
        variables=TORN,
    )
    store, root = Store(tmp_path), tmp_path / "exposures" / "x.zarr"
    product.prepare(store)
    written = [product.write(index, store) for index in range(2)]
    before = {path: path.read_bytes() for path in sorted(root.glob("*/c/**/*")) if path.is_file()}
    own = [path for path in before if path.relative_to(root).parts[2] == "1" and path.parts[-3] != "exposure"]
    assert len(own) == 2 + 1 + 2, "two shards, one of both planes, two files without shards"
    for path in own:
        path.unlink() if damage is None else path.write_bytes(damage(before[path]))
        with pytest.raises(UserError, match="is damaged"):
            product.stored(store).reader(1)(path.relative_to(root).parts[0])
    assert product.write(1, store) == written[1]
    assert {path: path.read_bytes() for path in before} == before
    assert product.verify(1, store) == written[1].output


def test_chunks_of_the_fill_value_are_stored_only_in_files_without_others(tmp_path):
    """What is left out of a file is in its index; a file of nothing else is written, so that a missing one is found."""
    part = Variable("part", "int32", (1024, 1024), ("y", "x"), {}, fill=-7)
    images = np.full((2, 1024, 1024), -7, np.int32)
    images[1, 600:700, 100:200] = np.random.default_rng(1).integers(0, 1 << 30, (100, 100))
    product = replace(image_product(2), make=lambda k: {"part": images[k]}, variables=(part,)).stored(Store(tmp_path))
    product.prepare(product.store)
    for index in range(2):
        made = product.write(index, product.store)
        np.testing.assert_array_equal(product.reader(index)("part"), images[index])
        assert product.verify(index, product.store) == made.output
    first, second = sorted(path for path in tmp_path.rglob("c/*/0/0") if path.is_file())
    # the index is at the end of a file, before its checksum: offset and length of each chunk, -1 for one left out
    for path, left_out in ((first, 0), (second, 3)):
        index = np.frombuffer(path.read_bytes()[-68:-4], "<i8").reshape(4, 2)
        assert (index == -1).all(axis=1).sum() == left_out
    first.unlink()
    with pytest.raises(UserError, match="is damaged"):
        product.reader(0)("part")


def test_images_are_read_back_and_arrays_grow_with_the_number_of_units(tmp_path):
    store = Store(tmp_path)
    image_product(3).prepare(store)
    first = image_product(3).write(1, store)
    image_product(5).prepare(store)
    image_product(5).write(4, store)
    array = zarr.open_group(store.images("exposures/x"), mode="r")["image"]
    assert array.shape == (5, 64, 48)
    np.testing.assert_array_equal(array[1], image_product(3).make(1)["image"])
    np.testing.assert_array_equal(array[4], image_product(3).make(4)["image"])
    assert first.output == digest({"image": digest(image_product(3).make(1)["image"])})


def test_products_that_differ_only_in_what_they_are_made_from_are_told_apart_by_dask():
    """Two surveys are compared in one graph, in which equal names would mean equal values."""
    first, second = image_product(2), replace(image_product(2), make=lambda k: {"image": np.ones((64, 48), np.float32)})
    difference = (first.dataset["image"] - second.dataset["image"]).compute()
    np.testing.assert_array_equal(difference[1], first.make(1)["image"] - 1)
    schema = pa.schema([pa.field("number", pa.int64())])
    tables = [
        TableProduct(
            stage="t/x",
            units=(Unit("u", 0),),
            schema=schema,
            make=lambda k, value=value: pd.DataFrame({"number": [value]}),
        )
        for value in (1, 2)
    ]
    assert [int(value) for value in dask.compute(*(table.frame["number"].sum() for table in tables))] == [1, 2]


def test_a_unit_without_a_record_is_made_although_its_data_are_stored(tmp_path):
    store = Store(tmp_path)
    product = image_product(2).stored(store)
    product.prepare(store)
    product.write(0, store)
    group = zarr.open_group(store.images("exposures/x"), mode="r+")
    group["image"][0] = 7.0
    np.testing.assert_array_equal(product.load(0)["image"], image_product(2).make(0)["image"])
    write_record(store, Record("exposures/x", "u0", "", "", 0, 0, 0.0, 0))
    assert (product.load(0)["image"] == 7.0).all()


def test_a_damaged_chunk_is_reported_with_the_remedy(tmp_path):
    store = Store(tmp_path)
    product = image_product(2).stored(store)
    product.prepare(store)
    product.write(1, store)
    path = next(path for path in store.images("exposures/x").rglob("image/c/1/**/*") if path.is_file())
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 4
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"exposures/x u1: image is damaged \(.+\): romandask verify --forget"):
        product.reader(1)("image")


def test_values_that_are_not_finite_are_never_written(tmp_path):
    store = Store(tmp_path)
    product = image_product(1)
    product.prepare(store)
    bad = replace(product, make=lambda k: {"image": np.full((64, 48), np.nan, np.float32)})
    with pytest.raises(ValueError, match="not finite"):
        bad.write(0, store)


def test_writing_does_not_change_the_dictionary_that_make_returns(tmp_path):
    """A maker may keep its result, such as the matter of a universe, and one process may write it to two stores."""
    kept = {"image": np.ones((64, 48), np.float32)}
    product = replace(image_product(1), make=lambda k: kept)
    for name in ("one", "two"):
        store = Store(tmp_path / name)
        product.prepare(store)
        product.write(0, store)
        assert list(kept) == ["image"]


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.8])
def test_a_flipped_byte_of_an_image_is_an_error_on_reading(tmp_path, fraction):
    store = Store(tmp_path)
    image_product(1).prepare(store)
    image_product(1).write(0, store)
    (shard,) = [path for path in (store.images("exposures/x") / "image" / "c").rglob("*") if path.is_file()]
    content = bytearray(shard.read_bytes())
    content[int(len(content) * fraction)] ^= 0x10
    shard.write_bytes(content)
    with pytest.raises((ValueError, RuntimeError)):
        zarr.open_group(store.images("exposures/x"), mode="r")["image"][0]


def test_a_flipped_byte_of_a_table_is_an_error_on_reading(tmp_path):
    path = tmp_path / "t.parquet"
    write_parquet(path, pa.table({"a": np.random.default_rng(0).normal(size=5000)}))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x01
    path.write_bytes(content)
    with pytest.raises(OSError, match=r"(?i)crc|checksum|corrupt"):
        read_parquet(path)


def test_files_are_written_atomically(tmp_path, monkeypatch):
    write_bytes(tmp_path / "f", b"old")

    def fail(*arguments):
        raise OSError("full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="full"):
        write_bytes(tmp_path / "f", b"new")
    assert (tmp_path / "f").read_bytes() == b"old"


def test_records_are_read_back_and_damaged_ones_are_ignored(tmp_path):
    store = Store(tmp_path)
    record = Record("a/b", "u", "in", "out", 1, 2, 3.0, 4, ["w"])
    write_record(store, record)
    assert read_record(store, "a/b", "u") == record
    store.record("a/b", "u").write_text('{"stage": ')
    assert read_record(store, "a/b", "u") is None


def test_digests_depend_on_values_types_and_shapes():
    arrays = [np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.float32), np.ones(4)]
    assert len({digest(array) for array in arrays}) == 4
    assert digest({"b": 1, "a": 2}) == digest({"a": 2, "b": 1})
    assert digest("ab", "c") != digest("a", "bc")


def test_tables_conform_to_their_schema():
    schema = pa.schema([pa.field("a", pa.int64()), pa.field("b", pa.float32())])
    assert conform(pd.DataFrame({"b": [1.0], "a": [2], "c": [3]}), schema, "t").column_names == ["a", "b"]
    with pytest.raises(UserError, match="t: column 'b' is missing"):
        conform(pd.DataFrame({"a": [1]}), schema, "t")
    with pytest.raises(UserError, match="column 'a' cannot be int64"):
        conform(pd.DataFrame({"a": [1.5], "b": [1.0]}), schema, "t")


def test_the_lazy_table_has_the_rows_of_all_units(tmp_path):
    schema = pa.schema([pa.field("a", pa.int64())])
    product = TableProduct(
        stage="t", units=(Unit("0", 0), Unit("1", 1)), make=lambda k: pd.DataFrame({"a": [k, k + 10]}), schema=schema
    )
    assert product.frame.compute(scheduler="synchronous")["a"].tolist() == [0, 10, 1, 11]


def test_a_store_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        Store(Path(tmp_path / "file" / "store")).prepare()


def test_lazy_units_are_constructed_on_access_and_serialised_as_names():
    constructed = []

    def make(index):
        constructed.append(index)
        return Unit(f"u{index}", {"index": index})

    units = LazyUnits(("u0", "u1", "u2"), make)
    assert names_of(units) == ("u0", "u1", "u2")
    assert constructed == []
    assert units[-1].settings == {"index": 2}
    assert [unit.name for unit in units[:2]] == ["u0", "u1"]
    assert constructed == [2, 0, 1]
    copy = pickle.loads(pickle.dumps(units))
    assert names_of(copy) == names_of(units)
    with pytest.raises(RuntimeError, match="serialised as names only"):
        copy[0]


def test_a_range_of_cells_is_read_from_a_file_with_several_row_groups(tmp_path):
    path = tmp_path / "t.parquet"
    cells = np.arange(0, 4_000_000, 20)
    write_parquet(path, pa.table({"_healpix_29": cells, "x": cells * 2.0, "y": cells * 0.0}))
    assert pq.ParquetFile(path).metadata.num_row_groups == 4
    rows = read_parquet(path, ["x"], (1_000_010, 1_000_100))
    assert rows.column_names == ["x"]
    np.testing.assert_array_equal(rows["x"].to_numpy() / 2, [1_000_020, 1_000_040, 1_000_060, 1_000_080])
    assert read_parquet(path, None, (9_000_000, 9_000_001)).num_rows == 0
