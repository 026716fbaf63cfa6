"""Settings of the stages that all instruments share, and how YAML and `key=value` text become settings.

Values only: user text reaches YAML's safe loader and pydantic, nothing that evaluates code.
"""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from romandask.model.errors import UserError
from romandask.model.sky import Region
from romandask.model.tiles import TileGrid


class Section(BaseModel):
    """A part of a pipeline file: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def distinct(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return values of which none is there twice."""
    again = [value for k, value in enumerate(values) if value in values[:k]]
    if again:
        raise ValueError(f"{again[0]} is there twice")
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


class RegionSettings(Section):
    """The patch of sky that the survey covers: a box; ra may cross 0 (then the first value is the larger)."""

    ra: tuple[float, float] = Field(description="right ascension from, to; degrees")
    dec: tuple[float, float] = Field(description="declination from, to; degrees")

    @model_validator(mode="after")
    def _ordered(self) -> RegionSettings:
        if not (-90 <= self.dec[0] < self.dec[1] <= 90):
            raise ValueError("dec must be [from, to] within -90..90 and increasing")
        if not all(0 <= value <= 360 for value in self.ra) or self.ra[0] == self.ra[1]:
            raise ValueError("ra must be [from, to], two different values within 0..360")
        return self

    def region(self) -> Region:
        """Return the box as a value."""
        return Region(self.ra[0], self.ra[1], self.dec[0], self.dec[1])


class TableSettings(Section):
    """A Parquet or FITS table of galaxies or of stars."""

    path: str = Field(description="file, or folder of Parquet files, below `data`")
    columns: dict[str, float | str] = Field(
        description="by column of ours the file's column, a number for all rows, or a text after '='"
    )


class TruthSettings(Section):
    """Where galaxies and stars come from."""

    source: Literal["generate", "skycatalogs", "instance_catalog", "table"] = "generate"
    path: str | None = Field(None, description="folder or file of the source catalog, below `data`")
    galaxy_table: TableSettings | None = Field(None, description="galaxies, with source: table")
    star_table: TableSettings | None = Field(None, description="stars, with source: table")
    seds: str | None = Field(None, description="folder of spectra that the catalog names, below `data`")
    order: int = Field(8, ge=3, le=12, description="HEALPix order of the partitions")
    margin: float = Field(20.0, ge=0, le=3600, description="objects this far outside the region are kept, arcsec")
    galaxies: float = Field(597.2, ge=0, description="galaxies to r < 29, per square arcminute")
    stars: float = Field(3.96, ge=0, description="stars to r < 29, per square arcminute")
    star_seds: str | None = Field(
        None, description="folder of spectra for generated stars, below `data`; blackbodies where there is none"
    )
    nside: Literal[64, 128, 256, 512, 1024, 2048, 4096] = Field(
        1024, description="HEALPix resolution of the matter shells, power of two"
    )
    shear: tuple[float, float] = Field(
        (0.0, 0.0), description="constant shear (gamma_1, gamma_2) added to the generated universe, all else the same"
    )
    milky_way_av: float = Field(0.03, ge=0, le=3, description="A_V of the Milky Way before generated objects, mag")
    dust: Literal["physical", "troxel2023"] = Field(
        "physical", description="internal dust in the rest frame, or in the observed frame as the paper did"
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
    """How light is drawn."""

    engine: Literal["fourier", "galsim"] = Field(
        "fourier", description="batched drawing in Fourier space, or GalSim object by object, a hundred times slower"
    )
    n_waves: int = Field(5, ge=2, le=20, description="PSFs across a band between which the PSF is interpolated")
    truncation: float = Field(
        0.04, gt=0, description="surface brightness at a stamp's edge, in units of the sky noise of a pixel"
    )
    largest: int = Field(2048, ge=64, le=4096, description="largest stamp, pixels a side (a power of two)")


class CoaddSettings(Section):
    """The tile grid and the resampling; pixels are those of the finest instrument."""

    scale: float = Field(0.0575, gt=0, description="pixel scale that `pixels` and `overlap` count in, arcsec")
    pixels: int = Field(8825, gt=32, description="side of a padded tile, pixels")
    overlap: int = Field(500, ge=0, description="padding on every edge, pixels")
    pixfrac: float = Field(0.7, gt=0, le=1, description="drop size over input pixel")
    noise: int = Field(1, ge=1, le=20, description="noise realisations of each tile and band")

    @model_validator(mode="after")
    def _has_inside(self) -> CoaddSettings:
        if self.pixels <= 2 * self.overlap:
            raise ValueError(f"pixels ({self.pixels}) leaves no inner area within two overlaps of {self.overlap}")
        return self

    def grid(self) -> TileGrid:
        """Return the tile grid of the survey."""
        return TileGrid((self.pixels - 2 * self.overlap) * self.scale, self.overlap * self.scale)


class DetectionSettings(Section):
    """Source Extractor's settings (Troxel et al. 2023, section 4.5); Rubin's peaks need the first two and `min_snr`."""

    threshold: float = Field(2.5, gt=0, description="of objects' pixels: sigma of one; in Rubin's PSF-smoothed image")
    min_area: int = Field(5, ge=1, description="least number of connected pixels")
    deblend_levels: int = Field(48, ge=1)
    deblend_contrast: float = Field(0.05, ge=0)
    match_radius: float = Field(1.0, gt=0, le=10, description="of an object's true counterpart, arcsec")
    summary_magnitude: float = Field(28.0, description="true objects fainter than this (H158, i) are not summarised")
    min_snr: float = Field(
        5.0, ge=0, description="least signal to noise in the detection image: of the Kron flux; of Rubin's, of the peak"
    )
    order: int = Field(8, ge=3, le=12, description="HEALPix order of the object tables' partitions")


class MatchSettings(Section):
    """Friends of friends over the samples of two surveys."""

    surveys: tuple[str, str] | None = Field(
        None, description="the sharp survey and the blended one; those that declare these parts if not given"
    )
    linking_lengths: Annotated[tuple[Annotated[float, Field(gt=0)], ...], AfterValidator(distinct)] = Field(
        (1.0, 0.5), min_length=1, description="arcsec"
    )
    sample: Literal["clean", "all"] = Field(
        "clean", description="clean: unflagged objects with a true counterpart, to the limits; all: every object"
    )
    limits: dict[str, float] | None = Field(
        None, description="faintest magnitude by reference band (H158, i); where counts fall to 80% if not given"
    )
    order: int = Field(8, ge=3, le=12, description="HEALPix order of the partitions")


class DifferenceSettings(Section):
    """Difference images: Rubin's tiles less Roman's, where the survey has both bands."""

    template: str = Field("Y106", description="band of the sharper survey")
    science: str = Field("y", description="band of the other survey, from which it is taken away")
    min_snr: float = Field(20.0, gt=0, description="of objects by which both are matched, and whose residuals are told")


class LensingSettings(Section):
    """Two-point functions of shear (Troxel et al. 2023, section 6.2)."""

    min_separation: float = Field(2.5, gt=0, description="arcmin")
    max_separation: float = Field(250.0, gt=0, description="arcmin; of a smaller region half its side")
    bins: int = Field(20, ge=1, le=100, description="logarithmic, between the two")
    patches: int = Field(40, ge=2, le=1000, description="of the sky, for the jackknife")

    @model_validator(mode="after")
    def _has_order(self) -> LensingSettings:
        if self.max_separation <= self.min_separation:
            raise ValueError(f"max_separation ({self.max_separation:g}) is not beyond min_separation")
        return self


class RunSettings(Section):
    """The local cluster."""

    workers: int = Field(2, ge=1)
    memory_limit: float = Field(2.0, gt=0.5, description="GiB a worker")


class _Loader(yaml.SafeLoader):
    """Plain values only; a key that is there twice is a mistake, not the last of the two."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        found: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in found:
                    raise yaml.MarkedYAMLError(problem=f"{key.value} is there twice", problem_mark=key.start_mark)
                found.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping that a YAML file holds; UserError where it holds none."""
    try:
        text = path.read_text()
        content = yaml.load(text, _Loader)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f" at line {where.line + 1}" if where else ""
        raise UserError(f"{path}: not valid YAML{line} ({getattr(error, 'problem', 'not text')})") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds {type(content).__name__}, expected a mapping of settings")
    return content


def apply_overrides(content: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Return the settings with `section.key=value` texts applied; values are read as YAML."""
    result = _copy(content)
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key.strip():
            raise UserError(f"{override!r}: an override is written key=value, for example coadds.pixfrac=0.8")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise UserError(f"{override!r}: {text!r} is not a valid value") from None
        place = result
        *parents, last = key.strip().split(".")
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                raise UserError(f"{override!r}: {parent} holds a value, not a section")
        place[last] = value
    return result


def validate(model: type[Section], content: dict[str, Any], source: str) -> Any:
    """Return the settings, or raise one UserError that names every wrong key of `source`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        lines = [_explain(model, item) for item in error.errors(include_url=False)]
        raise UserError(f"{source}: " + "; ".join(lines)) from None


def _explain(model: type[Section], item: Any) -> str:
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
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return next((found for arg in typing.get_args(annotation) if (found := _section_of(arg))), None)
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _copy(content: Any) -> Any:
    return {key: _copy(value) for key, value in content.items()} if isinstance(content, dict) else content
