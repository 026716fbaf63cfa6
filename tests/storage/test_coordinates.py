"""Coordinates of image products: written once, and again only if they change or are damaged."""

import numpy as np
import pytest

from romandask.storage.arrays import write_coordinate, write_group

VALUES = [np.array(["a", "bc"], object), np.array([1.5, np.pi]), np.array([3, 4], np.int64)]


@pytest.mark.parametrize("values", VALUES, ids=lambda values: values.dtype.str)
def test_the_same_coordinate_is_not_written_again(tmp_path, values):
    group = write_group(tmp_path / "x.zarr", "a")
    write_coordinate(group, "c", values, ("tile",), {"units": "deg"})
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "x.zarr" / "c").rglob("*") if path.is_file()}
    write_coordinate(group, "c", values, ("tile",), {"units": "deg"})
    assert {path: path.stat().st_mtime_ns for path in files} == files
    write_coordinate(group, "c", values, ("band",), {"units": "deg"})
    assert group["c"].metadata.dimension_names == ("band",)
    write_coordinate(group, "c", values[::-1], ("band",), {"units": "deg"})
    assert group["c"][...].tolist() == values[::-1].tolist()
    chunk = next(path for path in (tmp_path / "x.zarr" / "c" / "c").rglob("*") if path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:5])
    write_coordinate(group, "c", values[::-1], ("band",), {"units": "deg"})
    assert group["c"][...].tolist() == values[::-1].tolist()
