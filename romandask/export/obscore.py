"""ObsCore 1.1: one row an image, in the columns by which archives describe observations; and maps of areas (MOC)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
from astropy.coordinates import SkyCoord
from astropy.table import Table

from romandask.model.errors import UserError

ENDINGS = {".vot": "votable", ".xml": "votable", ".fits": "fits", ".parquet": "parquet"}
UCDS = {"nJy": "phot.flux.density", "electron": "phot.count"}
COLUMNS: dict[str, tuple[str, str]] = {
    "dataproduct_type": ("", "meta.code.class"),
    "calib_level": ("", "meta.code;obs.calib"),
    "obs_collection": ("", "meta.id"),
    "obs_id": ("", "meta.id"),
    "obs_publisher_did": ("", "meta.ref.ivoid"),
    "access_url": ("", "meta.ref.url"),
    "access_format": ("", "meta.code.mime"),
    "access_estsize": ("kbyte", "phys.size;meta.file"),
    "target_name": ("", "meta.id;src"),
    "s_ra": ("deg", "pos.eq.ra"),
    "s_dec": ("deg", "pos.eq.dec"),
    "s_fov": ("deg", "phys.angSize;instr.fov"),
    "s_region": ("", "pos.outline;obs.field"),
    "s_resolution": ("arcsec", "pos.angResolution"),
    "s_xel1": ("", "meta.number"),
    "s_xel2": ("", "meta.number"),
    "t_min": ("d", "time.start;obs.exposure"),
    "t_max": ("d", "time.end;obs.exposure"),
    "t_exptime": ("s", "time.duration;obs.exposure"),
    "t_resolution": ("s", "time.resolution"),
    "t_xel": ("", "meta.number"),
    "em_min": ("m", "em.wl;stat.min"),
    "em_max": ("m", "em.wl;stat.max"),
    "em_res_power": ("", "spect.resolution"),
    "em_xel": ("", "meta.number"),
    "o_ucd": ("", "meta.ucd"),
    "pol_states": ("", "meta.code;phys.polarization"),
    "pol_xel": ("", "meta.number"),
    "facility_name": ("", "meta.id;instr.tel"),
    "instrument_name": ("", "meta.id;instr"),
    "s_pixel_scale": ("arcsec", "phys.angSize;instr.pixel"),
    "em_band": ("", "instr.bandpass"),
}
"""The mandatory columns of table 1 of ObsCore 1.1, with units and UCDs, then two that are optional."""


def check(path: Path) -> None:
    """Raise a UserError where a file's ending names no format of tables."""
    if path.suffix not in ENDINGS:
        raise UserError(f"{path}: the ending must be one of {', '.join(ENDINGS)}")


def table_of(rows: pd.DataFrame) -> Table:
    """Return the ObsCore table of images.

    Parameters
    ----------
    rows : obs_id, stage, index, place, calib_level, corners (4, 2; degrees), fov, pixels, pixel_scale, fwhm (arcsec;
        NaN where it is not known), t_min, t_max, t_exptime, em (nm), unit, bytes, survey, facility (telescope,
        camera), band
    """
    corners = np.stack(list(rows["corners"]))
    middle = _middle(corners)
    low, high = np.array(list(rows["em"])).T * 1e-9
    pixels = np.array(list(rows["pixels"]))
    names = list(rows["facility"])
    count = len(rows)
    columns = {
        "dataproduct_type": ["image"] * count,
        "calib_level": rows["calib_level"].to_numpy(np.int32),
        "obs_collection": list(rows["survey"]),
        "obs_id": list(rows["obs_id"]),
        "obs_publisher_did": [f"ivo://romandask/{r.survey}?{r.stage}/{r.obs_id}" for r in rows.itertuples()],
        # the array index of the image in its Zarr group
        "access_url": [f"file://{r.place}#{r.index}" for r in rows.itertuples()],
        "access_format": ["application/vnd+zarr"] * count,
        "access_estsize": (rows["bytes"].to_numpy(np.int64) + 999) // 1000,
        "target_name": [""] * count,
        "s_ra": middle[:, 0],
        "s_dec": middle[:, 1],
        "s_fov": rows["fov"].to_numpy(float),
        "s_region": ["POLYGON ICRS " + " ".join(f"{value:.7f}" for value in one.ravel()) for one in corners],
        "s_resolution": rows["fwhm"].to_numpy(float),
        "s_xel1": pixels[:, 1].astype(np.int64),
        "s_xel2": pixels[:, 0].astype(np.int64),
        "t_min": rows["t_min"].to_numpy(float),
        "t_max": rows["t_max"].to_numpy(float),
        "t_exptime": rows["t_exptime"].to_numpy(float),
        "t_resolution": rows["t_exptime"].to_numpy(float),
        "t_xel": np.ones(count, np.int64),
        "em_min": low,
        "em_max": high,
        "em_res_power": (low + high) / 2 / (high - low),
        "em_xel": np.ones(count, np.int64),
        "o_ucd": [UCDS[unit] for unit in rows["unit"]],
        "pol_states": [""] * count,
        "pol_xel": np.zeros(count, np.int64),
        "facility_name": [name for name, _ in names],
        "instrument_name": [name for _, name in names],
        "s_pixel_scale": rows["pixel_scale"].to_numpy(float),
        "em_band": list(rows["band"]),
    }
    table = Table(columns)
    for name, (unit, ucd) in COLUMNS.items():
        table[name].meta["ucd"] = ucd
        if unit:
            table[name].unit = unit
    return table


def write(path: Path, rows: pd.DataFrame) -> None:
    """Write the ObsCore table of images (see `table_of`) in the format that the file's ending names."""
    table = table_of(rows)
    if ENDINGS[path.suffix] == "parquet":
        pd.DataFrame({name: np.asarray(table[name]) for name in table.colnames}).to_parquet(path)
    else:
        table.write(path, format=ENDINGS[path.suffix], overwrite=True)


def _middle(corners: np.ndarray) -> np.ndarray:
    """Return the centres (n, 2) of polygons (n, k, 2) on the sphere, degrees."""
    ra, dec = np.radians(corners).transpose(2, 0, 1)
    x, y, z = np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)
    x, y, z = x.mean(axis=1), y.mean(axis=1), z.mean(axis=1)
    return np.degrees(np.stack([np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))], axis=-1))


def write_moc(path: Path, polygons: list[np.ndarray], order: int) -> None:
    """Write the union of polygons (k, 2; degrees) as a MOC, FITS.

    Raises
    ------
    UserError
        If the package mocpy is not there.
    """
    if find_spec("mocpy") is None:
        raise UserError("maps of areas need the package mocpy: pip install 'romandask[moc]'")
    from mocpy import MOC  # noqa: PLC0415  an extra

    rings = [SkyCoord(one[:, 0], one[:, 1], unit="deg") for one in polygons]
    moc = MOC.from_polygons(rings, max_depth=order)
    whole = moc[0].union(*moc[1:]) if len(moc) > 1 else moc[0]
    whole.save(path, format="fits", overwrite=True)
