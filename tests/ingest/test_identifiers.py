"""An identifier is the same integer, whatever the type of its column; what is no identifier is told."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import Table

from romandask.ingest import parquet, table
from romandask.ingest.identifiers import MISSING, identifiers
from romandask.model.errors import UserError

GAIA = 5853498713190525696
STAR = {"id": "id", "ra": "ra", "dec": "dec", "magnorm": "mag", "sed": "=blackbody_5800"}


def stars(ids) -> dict:
    return {"id": ids, "ra": [10.0, 11.0, 12.0], "dec": [0.0, 1.0, 2.0], "mag": [20.0, 21.0, 22.0]}


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (pa.array([GAIA, 2**63 - 1, 0]), [GAIA, 2**63 - 1, 0]),
        (
            pa.array([GAIA, 2**63 - 1, 2**63], pa.uint64()),
            [GAIA, 2**63 - 1, "id 9223372036854775808 is above 2^63 - 1"],
        ),
        (pa.array([1, 2, 255], pa.uint8()), [1, 2, 255]),
        (pa.array([GAIA, None, -3]), [GAIA, MISSING, "id -3 is negative"]),
        (pa.array([str(GAIA), f" {2**63 - 1} ", "+7"]), [GAIA, 2**63 - 1, 7]),
        (pa.array([f"000000000000000{GAIA}", None, "9" * 5000]), [GAIA, MISSING, f"id '{'9' * 40}' is above 2^63 - 1"]),
        (pa.array(["12a", "", "-4"]), ["id '12a' is not an integer", MISSING, "id '-4' is negative"]),
        (pa.array([str(GAIA), "8", None]).dictionary_encode(), [GAIA, 8, MISSING]),
        (pa.array([Decimal(GAIA), None, Decimal(3)], pa.decimal128(20, 0)), [GAIA, MISSING, 3]),
        (
            pa.array([Decimal("20.00"), Decimal("3.50"), None], pa.decimal128(20, 2)),
            [20, "id '3.5' is not an integer", MISSING],
        ),
        (pa.array([2.0**24 - 1, 7, np.nan], pa.float32()), [2**24 - 1, 7, MISSING]),
        (pa.array([2.0**53 - 1, 7, None], pa.float64()), [2**53 - 1, 7, MISSING]),
        (pa.array([[GAIA], [8], None], pa.list_(pa.int64(), 1)), [GAIA, 8, MISSING]),
        (pa.nulls(3), [MISSING] * 3),
    ],
)
def test_parquet_columns_of_any_type(tmp_path, column, expected):
    content = {**stars(column), "id": column}
    pq.write_table(pa.table(content), tmp_path / "t.parquet")
    source = table.open_source(tmp_path / "t.parquet", STAR, "star")
    frame = source.read(source.batches()[0])
    found = [number if number >= 0 else reason for number, reason in zip(frame["id"], frame["reason"], strict=True)]
    assert found == expected
    assert frame["id"].dtype == np.int64


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "u4", "i8", "u8", "U20", "f4", "f8"])
def test_fits_columns_of_any_type(tmp_path, dtype):
    largest = {"U20": GAIA, "f4": 2**24 - 1, "f8": 2**53 - 1}.get(dtype) or min(np.iinfo(dtype).max, 2**63 - 1)
    ids = np.array([largest, 1, 2]).astype(dtype)
    Table(stars(ids)).write(tmp_path / "t.fits")
    source = table.open_source(tmp_path / "t.fits", STAR, "star")
    assert source.read(source.batches()[0])["id"].tolist() == [largest, 1, 2]


@pytest.mark.parametrize("suffix", ["parquet", "fits"])
@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            np.array([1, 2, 2**24], np.float32),
            r"column 'id' \(for id\) holds 16777216\.0 as a 32-bit float.*below 2\^24",
        ),
        (np.array([1, 2, 2.0**53]), r"holds 9007199254740992\.0 as a 64-bit float"),
        (np.array([1, np.nan, 2.5]), r"holds 2\.5 as"),
        (np.array([1, 2, np.inf]), "holds inf as"),
    ],
)
def test_floats_that_are_no_integers_or_not_exact_are_refused(tmp_path, suffix, values, words):
    path = tmp_path / f"t.{suffix}"
    if suffix == "fits":
        Table(stars(values)).write(path)
    else:
        pq.write_table(pa.table(stars(pa.array(values))), path)
    with pytest.raises(UserError, match=words):
        table.open_source(path, STAR, "star")


def test_a_pattern_says_which_part_of_a_text_is_the_identifier():
    found = identifiers(np.array(["a_7", "b7", "c_" + "9" * 19], object), "[a-z]_([0-9]+)")
    assert found.values.tolist() == [7, -1, -1]
    assert found.reason[1] == "id 'b7' is not an integer"
    assert found.reason[2].endswith("is above 2^63 - 1")
    assert len(parquet.identifiers_of(pa.chunked_array([pa.array([], pa.string())])).values) == 0
