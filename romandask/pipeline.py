"""A pipeline: the settings of one survey, from a YAML file or the name of one that came with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import Field, model_validator

from romandask.instruments.instrument import Instrument
from romandask.instruments.roman.calibration_source import CalibrationSource
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.model.errors import UserError
from romandask.model.resources import resource_folder
from romandask.model.settings import (
    CoaddSettings,
    DetectionSettings,
    DifferenceSettings,
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
from romandask.storage.paths import AnyPath, access_errors_explained, parse_path, resolve_below


class Pipeline(Section):
    """Everything that decides what a survey contains; the block of an instrument may be left out."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    description: str = ""
    seed: int = Field(ge=0)
    data: str = Field(".", description="folder that the paths of source files are below")
    region: RegionSettings
    truth: TruthSettings = TruthSettings()
    render: RenderSettings = RenderSettings()
    roman: RomanSettings | None = None
    rubin: RubinSettings | None = None
    coadds: CoaddSettings = CoaddSettings()
    detections: DetectionSettings = DetectionSettings()
    matches: MatchSettings = MatchSettings()
    lensing: LensingSettings = LensingSettings()
    differences: DifferenceSettings = DifferenceSettings()
    run: RunSettings = RunSettings()

    @model_validator(mode="after")
    def _has_survey(self) -> Pipeline:
        if self.roman is None and self.rubin is None:
            raise ValueError("sections roman and rubin are both left out: a survey has one of them, or both")
        return self

    def instruments(self) -> dict[str, Instrument]:
        """Return the instruments of this survey by name, in order."""
        found: dict[str, Instrument] = {}
        if self.roman is not None:
            found["roman"] = Roman(self.roman, self.render.n_waves, self.calibration())
        if self.rubin is not None:
            found["rubin"] = Rubin(self.rubin, self.render.n_waves, seed=self.seed)
        return found

    def block(self, survey: str) -> RomanSettings | RubinSettings:
        """Return the block of an instrument."""
        found: RomanSettings | RubinSettings | None = {"roman": self.roman, "rubin": self.rubin}[survey]
        assert found is not None
        return found

    def calibration(self) -> CalibrationSource | None:
        """Return where the calibrations of Roman's SCAs come from; None where they have none."""
        if self.roman is None or self.roman.detector == "simple":
            return None
        folder = self.roman.calibration
        return CalibrationSource(None if folder is None else resolve_below(parse_path(self.data), folder), self.seed)

    def to_yaml(self) -> str:
        """Return the resolved settings as YAML."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def load_pipeline(source: str | AnyPath, overrides: list[str] | None = None) -> Pipeline:
    """Return the settings of a YAML file, or of a pipeline that came with the package, with overrides applied.

    Raises
    ------
    UserError
        Naming the file and every key that is unknown (with the nearest valid one), missing or wrong.
    """
    found = _find(source)
    with access_errors_explained(found):
        content = apply_overrides(read_yaml(found), overrides or [])
    settings: Pipeline = validate(Pipeline, content, str(source))
    # workers, and whoever opens the store later, need not share this working directory
    return settings.model_copy(update={"data": str(parse_path(settings.data, "data"))})


def pipeline_of(content: dict[str, Any], source: str) -> Pipeline:
    """Return the settings of a mapping."""
    return validate(Pipeline, content, source)


def shipped() -> list[str]:
    """Return the names of the pipelines that came with the package."""
    return sorted(path.stem for path in resource_folder("pipelines").glob("*.yaml"))


def _find(source: str | AnyPath) -> AnyPath:
    if "://" in str(source):
        return parse_path(source, "a pipeline")
    path = Path(str(source))
    if path.is_file():
        return path
    inside = resource_folder("pipelines") / f"{path.name.removesuffix('.yaml')}.yaml"
    # a name, or the path that it has in the project's own folder
    if inside.is_file() and str(path.parent) in (".", "pipelines"):
        return inside
    raise UserError(f"{path}: no such pipeline file; the package has {', '.join(shipped())}")
