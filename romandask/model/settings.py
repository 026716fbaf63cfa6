"""Settings of the stages that all instruments share, and the parsing of YAML files and `key=value` overrides.

User text is parsed by YAML's safe loader and validated by pydantic; it is never evaluated as code.
"""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from romandask.model.errors import UserError
from romandask.model.filters import FilterNames, any_band, keys_by
from romandask.model.sky import Region
from romandask.model.tiles import TileGrid


class Section(BaseModel):
    """Base class of the sections of a pipeline file: immutable; unknown keys and non-finite numbers are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def distinct(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the values unchanged if no two are equal; a pydantic validator.

    Raises
    ------
    ValueError
        If a value is repeated.
    """
    repeated = [value for k, value in enumerate(values) if value in values[:k]]
    if repeated:
        raise ValueError(f"{repeated[0]} is there twice")
    return values


def one_of(names: Iterable[str]) -> Callable[[str], str]:
    """Return a validator that takes one of some names."""
    known = tuple(names)

    def validator(value: str) -> str:
        if value not in known:
            *others, last = (repr(name) for name in known)
            raise ValueError(f"Input should be {', '.join(others)} or {last} (found {value!r})")
        return value

    return validator


def band_in(bands: Collection[str], names: FilterNames) -> Callable[[str], str]:
    """Return a validator that takes any name of some bands, and returns the band."""
    known = one_of(bands)

    def validator(name: str) -> str:
        band = names.find(name, bands)
        return band if band is not None and band in bands else known(name)

    return validator


class RegionSettings(Section):
    """The survey's region: a box in right ascension and declination.

    If the box crosses right ascension 0, the first value of `ra` is larger than the second.
    """

    ra: tuple[float, float] = Field(description="lower and upper right ascension, degrees")
    dec: tuple[float, float] = Field(description="lower and upper declination, degrees")

    @model_validator(mode="after")
    def _ordered(self) -> RegionSettings:
        if not (-90 <= self.dec[0] < self.dec[1] <= 90):
            raise ValueError("dec must be [from, to] within -90..90 and increasing")
        if not all(0 <= value <= 360 for value in self.ra) or self.ra[0] == self.ra[1]:
            raise ValueError("ra must be [from, to], two different values within 0..360")
        return self

    def region(self) -> Region:
        """Return the box as a `Region`."""
        return Region(self.ra[0], self.ra[1], self.dec[0], self.dec[1])


class TableSettings(Section):
    """A user-supplied Parquet or FITS table of galaxies or of stars."""

    path: str = Field(description="file, or folder of Parquet files; relative to `data`")
    columns: dict[str, float | str] = Field(
        description="for each truth catalog column: the name of the file's column, a number used for all rows, or "
        "'=' followed by a text used for all rows"
    )


class TruthSettings(Section):
    """The truth catalogs: the source of galaxies and stars."""

    source: Literal["generate", "skycatalogs", "instance_catalog", "table"] = "generate"
    path: str | None = Field(None, description="folder or file of the source catalog; relative to `data`")
    galaxy_table: TableSettings | None = Field(None, description="table of galaxies, with source: table")
    star_table: TableSettings | None = Field(None, description="table of stars, with source: table")
    seds: str | None = Field(
        None, description="folder of the spectra named in the catalog, or an exported seds.hdf5; relative to `data`"
    )
    order: int = Field(8, ge=3, le=12, description="HEALPix order of the catalog partitions")
    margin: float = Field(
        20.0, ge=0, le=3600, description="distance outside the region to which objects are kept, arcsec"
    )
    galaxies: float = Field(597.2, ge=0, description="generated galaxies with r < 29 per square arcminute")
    stars: float = Field(3.96, ge=0, description="generated stars with r < 29 per square arcminute")
    star_seds: str | None = Field(
        None,
        description="folder of spectra for generated stars; relative to `data`; blackbody spectra are used if not set",
    )
    nside: Literal[64, 128, 256, 512, 1024, 2048, 4096] = Field(
        1024, description="HEALPix nside of the matter shells, a power of two"
    )
    shear: tuple[float, float] = Field(
        (0.0, 0.0),
        description="constant shear (gamma_1, gamma_2) added to the shear of the generated universe; nothing else "
        "changes",
    )
    milky_way_av: float = Field(
        0.03, ge=0, le=3, description="Milky Way extinction A_V in front of generated objects, mag"
    )
    dust: Literal["physical", "troxel2023"] = Field(
        "physical",
        description="frame of the internal dust; physical: rest frame, troxel2023: observed frame, as in the paper",
    )

    @model_validator(mode="after")
    def _has_path(self) -> TruthSettings:
        if self.source in ("skycatalogs", "instance_catalog") and not self.path:
            raise ValueError(f"truth.path is needed with source: {self.source}")
        if self.source == "table" and self.galaxy_table is None and self.star_table is None:
            raise ValueError("truth.galaxy_table or truth.star_table is needed with source: table")
        if np.hypot(*self.shear) > 0.2:
            raise ValueError(f"truth.shear {self.shear} is beyond the weak regime: at most 0.2")
        return self


class RenderSettings(Section):
    """Rendering of galaxies and stars."""

    engine: Literal["fourier", "galsim"] = Field(
        "fourier",
        description="fourier: batched drawing in Fourier space; galsim: GalSim, one object at a time, a hundred times "
        "slower",
    )
    n_waves: int = Field(
        5,
        ge=2,
        le=20,
        description="number of wavelengths per band at which the PSF is computed; it is interpolated linearly between",
    )
    truncation: float = Field(
        0.04, gt=0, description="surface brightness at the edge of a stamp, in units of the sky noise of a pixel"
    )
    largest: int = Field(2048, ge=64, le=4096, description="largest stamp, pixels a side (a power of two)")


class ExposureSettings(Section):
    """Exposures. Only simple detectors (Roman's `detector: simple`) are drawn in part; others are always whole."""

    area: Literal["detector", "region"] = Field("detector", description="draw whole detectors, or what the tiles need")


class CoaddSettings(Section):
    """The tile grid and the coaddition.

    `pixels` and `overlap` count pixels of the instrument with the finest coadd pixels. All instruments share the tile
    grid in arcsec.
    """

    scale: float = Field(0.0575, gt=0, description="size of the pixels in which `pixels` and `overlap` count, arcsec")
    pixels: int = Field(8825, gt=32, description="side of a padded tile, pixels")
    overlap: int = Field(500, ge=0, description="padding on each edge of a tile, pixels")
    pixfrac: float = Field(0.7, gt=0, le=1, description="drizzle drop size, in units of the input pixel")
    noise: int = Field(1, ge=1, le=20, description="number of noise realisations of each tile and band")
    patch_pixels: int = Field(
        2048,
        ge=32,
        description="approximate side of a patch, pixels of the coadd; tiles are made, stored and measured by patches, "
        "and the memory of a worker grows with their area",
    )

    @model_validator(mode="after")
    def _has_inside(self) -> CoaddSettings:
        if self.pixels <= 2 * self.overlap:
            raise ValueError(f"pixels ({self.pixels}) leaves no inner area within two overlaps of {self.overlap}")
        return self

    def grid(self) -> TileGrid:
        """Return the tile grid of the survey."""
        return TileGrid((self.pixels - 2 * self.overlap) * self.scale, self.overlap * self.scale)


class DetectionSettings(Section):
    """Source detection and measurement with Source Extractor (Troxel et al. 2023, section 4.5).

    The detection of peaks for Rubin uses only `threshold`, `min_area` and `min_snr`.
    """

    threshold: float = Field(
        2.5,
        gt=0,
        description="detection threshold of a pixel, in units of the pixel noise; for Rubin, in the image smoothed "
        "with the PSF",
    )
    min_area: int = Field(5, ge=1, description="minimum number of connected pixels of an object")
    deblend_levels: int = Field(48, ge=1, description="number of deblending thresholds")
    deblend_contrast: float = Field(0.05, ge=0, description="minimum contrast for deblending")
    match_radius: float = Field(
        1.0, gt=0, le=10, description="largest distance of an object from its true counterpart, arcsec"
    )
    summary_magnitude: float = Field(
        28.0, description="faintest magnitude (H158, i) of the true objects in the summaries"
    )
    min_snr: float = Field(
        5.0,
        ge=0,
        description="minimum signal-to-noise ratio in the detection image: of the Kron flux; for Rubin, of the peak",
    )
    order: int = Field(8, ge=3, le=12, description="HEALPix order of the partitions of the object tables")


class MatchSettings(Section):
    """Friends-of-friends matching of the object samples of two surveys."""

    surveys: tuple[str, str] | None = Field(
        None, description="the sharp survey and the blended one; those that declare these parts if not given"
    )
    linking_lengths: Annotated[tuple[Annotated[float, Field(gt=0)], ...], AfterValidator(distinct)] = Field(
        (1.0, 0.5), min_length=1, description="linking lengths, arcsec"
    )
    sample: Literal["clean", "all"] = Field(
        "clean",
        description="clean: unflagged objects with a true counterpart, brighter than the limits; all: every object",
    )
    limits: Annotated[dict[str, float] | None, BeforeValidator(keys_by(any_band))] = Field(
        None,
        description="faintest magnitude for each reference band (H158, i); if not set, where the counts fall to "
        "80% of a power law",
    )
    order: int = Field(8, ge=3, le=12, description="HEALPix order of the partitions of the match tables")


class DifferenceSettings(Section):
    """Difference images of two surveys' coadds; made if the survey has both bands."""

    template: Annotated[str, AfterValidator(any_band)] = Field(
        "Y106", description="band of the template, the sharper survey's coadd that is subtracted"
    )
    science: Annotated[str, AfterValidator(any_band)] = Field(
        "y", description="band of the science image, the coadd that the template is subtracted from"
    )
    min_snr: float = Field(
        20.0,
        gt=0,
        description="minimum signal-to-noise ratio of the objects that the two images are matched with and whose "
        "residuals are reported",
    )


class LensingSettings(Section):
    """Shear two-point correlation functions (Troxel et al. 2023, section 6.2)."""

    min_separation: float = Field(2.5, gt=0, description="smallest separation, arcmin")
    max_separation: float = Field(
        250.0, gt=0, description="largest separation, arcmin; at most half the shorter side of the region is used"
    )
    bins: int = Field(20, ge=1, le=100, description="number of logarithmic bins between the two separations")
    patches: int = Field(40, ge=2, le=1000, description="number of sky patches for the jackknife")

    @model_validator(mode="after")
    def _has_order(self) -> LensingSettings:
        if self.max_separation <= self.min_separation:
            raise ValueError(f"max_separation ({self.max_separation:g}) is not beyond min_separation")
        return self


class RunSettings(Section):
    """The local dask cluster."""

    workers: int = Field(2, ge=1, description="number of worker processes")
    memory_limit: float = Field(2.0, gt=0.5, description="memory limit of each worker, GiB")


class _Loader(yaml.SafeLoader):
    """Safe YAML loader that rejects duplicate keys; the base class silently keeps the last value."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in keys:
                    raise yaml.MarkedYAMLError(problem=f"{key.value} is there twice", problem_mark=key.start_mark)
                keys.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the top-level mapping of a YAML file.

    Raises
    ------
    UserError
        If the file cannot be read, is not valid YAML, repeats a key, or holds anything but a mapping.
    """
    try:
        text = path.read_text()
        content = yaml.load(text, _Loader)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}: not valid YAML{line} ({getattr(error, 'problem', 'not text')})") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds {type(content).__name__}, expected a mapping of settings")
    return content


def apply_overrides(content: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Return a copy of the settings with overrides applied.

    Parameters
    ----------
    content : dict
        Nested settings, as read from a pipeline file.
    overrides : list of str
        Overrides of the form ``section.key=value``; values are parsed as YAML.

    Raises
    ------
    UserError
        If an override has another form, its value is not valid YAML, or it sets a key below a plain value.
    """
    result = _copy(content)
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key.strip():
            raise UserError(f"{override!r}: an override is written key=value, for example coadds.pixfrac=0.8")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise UserError(f"{override!r}: {text!r} is not a valid value") from None
        section = result
        *parents, last = key.strip().split(".")
        for parent in parents:
            section = section.setdefault(parent, {})
            if not isinstance(section, dict):
                raise UserError(f"{override!r}: {parent} holds a value, not a section")
        section[last] = value
    return result


def validate(model: type[Section], content: dict[str, Any], source: str) -> Any:
    """Return the validated settings.

    Parameters
    ----------
    model : type
        Section class of the settings.
    content : dict
        Nested settings, as read from a pipeline file, with overrides applied.
    source : str
        Name of the pipeline file, for the message of an error.

    Raises
    ------
    UserError
        If any setting is wrong; one message names every wrong key.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = [_explain(model, item) for item in error.errors(include_url=False)]
        raise UserError(f"{source}: " + "; ".join(problems)) from None


def _explain(model: type[Section], item: Any) -> str:
    """Return the message for one of pydantic's errors."""
    location = [str(part) for part in item["loc"]]
    key = ".".join(location)
    if item["type"] == "extra_forbidden":
        known = _keys_at(model, location[:-1])
        close = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f", did you mean {'.'.join([*location[:-1], close[0]])}?" if close else f"; valid: {', '.join(known)}"
        return f"unknown key {key}{hint}"
    if item["type"] == "missing":
        return f"missing key {key}"
    message = item["msg"].removeprefix("Value error, ")
    return f"{key}: {message}" + ("" if item["type"] == "value_error" else f" (found {item['input']!r})")


def _keys_at(model: type[BaseModel], location: list[str]) -> list[str]:
    """Return the valid keys of the section at `location`."""
    for part in location:
        field = model.model_fields.get(part)
        nested = _section_of(field.annotation) if field else None
        if nested is None:
            return []
        model = nested
    return list(model.model_fields)


def _section_of(annotation: Any) -> type[BaseModel] | None:
    """Return the section class in a field's annotation, or None if it holds plain values."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return next((section for arg in typing.get_args(annotation) if (section := _section_of(arg))), None)
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _copy(content: Any) -> Any:
    """Return a copy of nested mappings; other values are shared."""
    return {key: _copy(value) for key, value in content.items()} if isinstance(content, dict) else content
