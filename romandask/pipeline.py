"""Pipelines: the settings of a survey, from a YAML file or from a pipeline that comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import Field, model_validator

from romandask.instruments.instrument import Instrument, InstrumentContext, InstrumentSettings
from romandask.instruments.roman.roman import RomanSettings
from romandask.instruments.rubin.rubin import RubinSettings
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.model.settings import (
    CoaddSettings,
    DetectionSettings,
    DifferenceSettings,
    ExposureSettings,
    LensingSettings,
    MatchSettings,
    RegionSettings,
    RenderSettings,
    RunSettings,
    Section,
    TruthSettings,
    apply_overrides,
    read_yaml,
    validate,
)
from romandask.storage.paths import AnyPath, access_errors_explained, parse_path


class Pipeline(Section):
    """Settings of a survey: everything that determines its content. The block of an instrument may be left out."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    description: str = ""
    seed: int = Field(ge=0)
    data: str = Field(".", description="folder that the paths of source files are below")
    region: RegionSettings
    truth: TruthSettings = TruthSettings()
    render: RenderSettings = RenderSettings()
    # instruments, in the order in which their products are made; a new telescope is one line here
    roman: RomanSettings | None = None
    rubin: RubinSettings | None = None
    exposures: ExposureSettings = ExposureSettings()
    coadds: CoaddSettings = CoaddSettings()
    detections: DetectionSettings = DetectionSettings()
    matches: MatchSettings = MatchSettings()
    lensing: LensingSettings = LensingSettings()
    differences: DifferenceSettings = DifferenceSettings()
    run: RunSettings = RunSettings()

    @model_validator(mode="after")
    def _has_survey(self) -> Pipeline:
        if not self.blocks():
            names = " and ".join(self.instrument_types())
            raise ValueError(f"sections {names} are both left out: a survey has one of them, or both")
        return self

    @model_validator(mode="after")
    def _has_bands_of_differences(self) -> Pipeline:
        known = [band for block_type in self.instrument_types().values() for band in block_type.every_band]
        for key in ("template", "science"):
            if (band := getattr(self.differences, key)) not in known:
                raise ValueError(f"differences.{key}: Input should be one of {', '.join(known)} (found {band!r})")
        return self

    @classmethod
    def instrument_types(cls) -> dict[str, type[InstrumentSettings]]:
        """Return the settings class of each instrument that a pipeline may have, by name."""
        return {
            name: block_type
            for name, info in cls.model_fields.items()
            for block_type in get_args(info.annotation)
            if isinstance(block_type, type) and issubclass(block_type, InstrumentSettings)
        }

    def blocks(self) -> dict[str, InstrumentSettings]:
        """Return the settings blocks of the instruments of this pipeline, by name, in order."""
        blocks = {name: getattr(self, name) for name in self.instrument_types()}
        return {name: block for name, block in blocks.items() if block is not None}

    def block(self, survey: str) -> InstrumentSettings:
        """Return the settings block of an instrument."""
        return self.blocks()[survey]

    def instruments(self) -> dict[str, Instrument]:
        """Return the instruments of this pipeline, by name, in order."""
        data = parse_path(self.data, "data")
        context = InstrumentContext(n_waves=self.render.n_waves, seed=self.seed, data=data)
        return {name: block.instrument(context) for name, block in self.blocks().items()}

    def to_yaml(self) -> str:
        """Return all settings, defaults included, as YAML."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def instrument_types() -> dict[str, type[InstrumentSettings]]:
    """Return the settings class of each instrument that a pipeline may have, by name."""
    return Pipeline.instrument_types()


def load_pipeline(source: str | AnyPath, overrides: list[str] | None = None) -> Pipeline:
    """Load a pipeline.

    Parameters
    ----------
    source : str or path
        YAML file, s3://BUCKET/FILE, or the name of a pipeline that comes with the package, for example `tiny`.
    overrides : list of str, optional
        Settings `key=value` that replace those of the file, for example `coadds.pixfrac=0.8`.

    Returns
    -------
    Pipeline
        Settings with an absolute path of the source files.

    Raises
    ------
    UserError
        If there is no such file, or a key is unknown, missing or wrong. The message names the file and each such key,
        with the nearest valid key for an unknown one.
    """
    path = _find(source)
    with access_errors_explained(path):
        content = apply_overrides(read_yaml(path), overrides or [])
    settings: Pipeline = validate(Pipeline, content, str(source))
    # an absolute path, because workers and later readers of the store may have another working directory
    return settings.model_copy(update={"data": str(parse_path(settings.data, "data"))})


def pipeline_of(content: dict[str, Any], source: str) -> Pipeline:
    """Return the settings of a mapping; `source` is its name in error messages."""
    return validate(Pipeline, content, source)


def shipped() -> list[str]:
    """Return the names of the pipelines that come with the package."""
    return sorted(path.stem for path in resource_folder("pipelines").glob("*.yaml"))


def _find(source: str | AnyPath) -> AnyPath:
    if "://" in str(source):
        return parse_path(source, "a pipeline")
    path = Path(str(source))
    if path.is_file():
        return path
    packaged = resource_folder("pipelines") / f"{path.name.removesuffix('.yaml')}.yaml"
    # a plain name, or its path in a checkout of the project
    if packaged.is_file() and str(path.parent) in (".", "pipelines"):
        return packaged
    raise UserError(f"{path}: no such pipeline file; the package has {', '.join(shipped())}")
