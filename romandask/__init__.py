"""romandask: a joint synthetic sky survey of the Roman Space Telescope and Rubin's LSST, as lazy dask graphs."""

import importlib
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from romandask.model.errors import UserError
    from romandask.model.sky import Cone, Region
    from romandask.pipeline import Pipeline, load_pipeline
    from romandask.run import run_on
    from romandask.stages.analysis.blend_statistics import statistics
    from romandask.stages.analysis.friends_of_friends import matches
    from romandask.stages.coadds.coadds import coadds
    from romandask.stages.cutouts import cutouts
    from romandask.stages.detections.detections import detect_and_measure, detections
    from romandask.stages.detections.field import ArrayField
    from romandask.stages.detections.objects import objects
    from romandask.stages.exposures.exposures import exposures
    from romandask.stages.pointings import pointings
    from romandask.stages.psf_images import psfs
    from romandask.stages.truth.catalogs import truth
    from romandask.stages.truth_index import truth_index
    from romandask.survey import Survey
    from romandask.survey import open_survey as open  # noqa: A004

__version__ = _version("romandask")

_MODULES = {
    "ArrayField": "romandask.stages.detections.field",
    "Cone": "romandask.model.sky",
    "Pipeline": "romandask.pipeline",
    "Region": "romandask.model.sky",
    "Survey": "romandask.survey",
    "UserError": "romandask.model.errors",
    "coadds": "romandask.stages.coadds.coadds",
    "cutouts": "romandask.stages.cutouts",
    "detect_and_measure": "romandask.stages.detections.detections",
    "detections": "romandask.stages.detections.detections",
    "exposures": "romandask.stages.exposures.exposures",
    "load_pipeline": "romandask.pipeline",
    "matches": "romandask.stages.analysis.friends_of_friends",
    "objects": "romandask.stages.detections.objects",
    "open": "romandask.survey",
    "pointings": "romandask.stages.pointings",
    "psfs": "romandask.stages.psf_images",
    "run_on": "romandask.run",
    "statistics": "romandask.stages.analysis.blend_statistics",
    "truth": "romandask.stages.truth.catalogs",
    "truth_index": "romandask.stages.truth_index",
}
"""Module of each public name. It is imported when the name is first used, because all together take seconds."""

__all__ = [
    "ArrayField",
    "Cone",
    "Pipeline",
    "Region",
    "Survey",
    "UserError",
    "coadds",
    "cutouts",
    "detect_and_measure",
    "detections",
    "exposures",
    "load_pipeline",
    "matches",
    "objects",
    "open",
    "pointings",
    "psfs",
    "run_on",
    "statistics",
    "truth",
    "truth_index",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), "open_survey" if name == "open" else name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
