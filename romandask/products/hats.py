"""HATS collections: spatial indices, margins, and the metadata files that pandas, pyarrow, hats and LSDB read."""

from __future__ import annotations

from dataclasses import dataclass

import cdshealpix.nested as healpix
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from hats.catalog import CatalogType, TableProperties
from hats.catalog.dataset.collection_properties import CollectionProperties
from hats.pixel_math.spatial_index import SPATIAL_INDEX_COLUMN, compute_spatial_index

from romandask.products.tables import TableProduct
from romandask.products.units import LazyUnits, Unit
from romandask.storage.manifest import read_record
from romandask.storage.paths import AnyPath, remove, write_bytes
from romandask.storage.store import MARGIN, Store

WIDTH = 10.0
"""Width of the margin of a partition, arcsec; larger than any linking length in use."""
RIM_ORDER = 13
"""HEALPix order of the ring of cells around a partition that is its margin.

The cells are 26 arcsec wide, and 18 arcsec where they are flattest.
"""
RIM = 18.0
"""Smallest width, arcsec, of the ring of cells around any partition."""


def with_spatial_index(frame: pd.DataFrame, ra: str = "ra", dec: str = "dec") -> pd.DataFrame:
    """Return the rows with their HEALPix cell of order 29 (column _healpix_29), sorted by it.

    Parameters
    ----------
    frame : DataFrame
        Rows with a position.
    ra, dec : str
        Columns of right ascension and declination, degrees.
    """
    index = compute_spatial_index(frame[ra].to_numpy(float), frame[dec].to_numpy(float))
    return frame.assign(**{SPATIAL_INDEX_COLUMN: index}).sort_values(
        SPATIAL_INDEX_COLUMN, kind="stable", ignore_index=True
    )


def margin(product: TableProduct) -> TableProduct:
    """Return the margin of a catalog.

    The margin of a partition contains the rows of other partitions that lie in the ring of cells around it, and so all
    rows within `WIDTH` of it.
    """
    order, pixels = product.order or 0, np.array(product.pixels or (), np.int64)
    rims = [rim(pixel, order) for pixel in pixels.tolist()]
    neighbours = [product.touching_cells(cells, RIM_ORDER) for cells in rims]

    def unit(index: int) -> Unit:
        inputs = tuple((product.stage, product.names[k]) for k in neighbours[index])
        return Unit(product.names[index], {"width": WIDTH, "rim": RIM_ORDER}, inputs)

    return TableProduct(
        stage=product.stage + MARGIN,
        units=LazyUnits(product.names, unit),
        make=_MakeMargin(product, order),
        schema=product.schema,
        pixels=product.pixels,
        order=product.order,
        bytes_per_unit=product.bytes_per_unit,
        seconds_per_unit=0.05 * product.seconds_per_unit,
        store=product.store,
    )


@dataclass(frozen=True)
class _MakeMargin:
    product: TableProduct
    order: int

    def __call__(self, index: int) -> pd.DataFrame:
        rows = self.product.rows_in(rim((self.product.pixels or ())[index], self.order), RIM_ORDER)
        return rows.sort_values(SPATIAL_INDEX_COLUMN, kind="stable", ignore_index=True)


def rim(pixel: int, order: int) -> np.ndarray:
    """Return the cells of order `RIM_ORDER` along the outside of a nested cell of another order, corners included."""
    edges, corners = healpix.external_neighbours(np.array([pixel], np.uint64), order, RIM_ORDER - order)
    cells = np.concatenate([np.ravel(edges), np.ravel(corners)]).astype(np.int64)
    # a missing corner is -1
    return np.unique(cells[cells >= 0])


def rows_around(product: TableProduct, pixel: int, order: int, columns: list[str]) -> pd.DataFrame:
    """Return the rows of a catalog in a HEALPix cell, followed by those in the ring of cells around it.

    Parameters
    ----------
    product : TableProduct
        Catalog to read.
    pixel, order : int
        Nested HEALPix cell and its order, which may differ from the order of the partitions.
    columns : list of str
        Columns to return; _healpix_29 is returned as well.
    """
    areas = [(np.array([pixel]), order), (rim(pixel, order), RIM_ORDER)]
    return pd.concat([product.rows_in(*area, columns) for area in areas])


def inner_rim(pixel: int, order: int) -> np.ndarray:
    """Return the cells of order `RIM_ORDER` along the inside of the edge of a nested cell of another order."""
    cells = np.unique(healpix.neighbours(rim(pixel, order).astype(np.uint64), RIM_ORDER).astype(np.int64))
    return cells[cells >> 2 * (RIM_ORDER - order) == pixel]


def write_catalog_files(product: TableProduct, store: Store, ra: str = "ra", dec: str = "dec") -> None:
    """Write the HATS metadata files of a stored catalog or margin.

    The files are hats.properties, partition_info.csv, dataset/_metadata and dataset/_common_metadata, and with the
    margin also collection.properties; so the files of the catalog itself must be written first. Partitions of an
    earlier configuration are removed.

    Parameters
    ----------
    product : TableProduct
        Catalog or margin; all its units are stored.
    store : Store
        Store with the catalog.
    ra, dec : str
        Columns of right ascension and declination.
    """
    root = store.catalog(product.stage)
    rows, metadata, filled_pixels = 0, None, []
    for name, pixel in zip(product.names, product.pixels or (), strict=True):
        record = read_record(store, product.stage, name)
        if record is None or record.rows == 0:
            continue
        path = store.partition(product.stage, product.order or 0, pixel)
        with path.open("rb") as file:
            footer = pq.read_metadata(file)
        footer.set_file_path(str(path.relative_to(root / "dataset")))
        if metadata is None:
            metadata = footer
        else:
            metadata.append_row_groups(footer)
        rows += record.rows
        filled_pixels.append(pixel)
    _remove_stale_partitions(product, store, set(filled_pixels))
    info = "Norder,Npix\n" + "".join(f"{product.order},{pixel}\n" for pixel in filled_pixels)
    write_bytes(root / "partition_info.csv", info.encode())
    for name, content in (("_common_metadata", None), ("_metadata", metadata)):
        sink = pa.BufferOutputStream()
        if content is None:
            pq.write_metadata(product.schema, sink)
        else:
            content.write_metadata_file(sink)
        write_bytes(root / "dataset" / name, sink.getvalue().to_pybytes())
    # validated from a mapping, because the signature of the model does not show its optional fields
    properties = dict(
        obs_collection=product.stage.replace("/", "_"),
        dataproduct_type=CatalogType.OBJECT,
        hats_nrows=rows,
        hats_col_ra=ra,
        hats_col_dec=dec,
        hats_col_healpix=SPATIAL_INDEX_COLUMN,
        hats_col_healpix_order=29,
    )
    if product.stage.endswith(MARGIN):
        primary = product.stage.removesuffix(MARGIN).replace("/", "_")
        properties |= dict(
            dataproduct_type=CatalogType.MARGIN, hats_primary_table_url=primary, hats_margin_threshold=WIDTH
        )
        _write_collection(store.collection(product.stage), primary)
    TableProperties.model_validate(properties).to_properties_file(root)


def _write_collection(folder: AnyPath, name: str) -> None:
    content = dict(
        obs_collection=name, hats_primary_table_url="catalog", all_margins=["margin"], default_margin="margin"
    )
    CollectionProperties.model_validate(content).to_properties_file(folder)


def _remove_stale_partitions(product: TableProduct, store: Store, filled_pixels: set[int]) -> None:
    """Remove partition files that belong to no unit of the catalog, as an earlier configuration leaves them."""
    dataset = store.catalog(product.stage) / "dataset"
    current = {store.partition(product.stage, product.order or 0, pixel) for pixel in filled_pixels}
    for path in dataset.glob("Norder=*/Dir=*/Npix=*.parquet"):
        if path not in current:
            remove(path)
