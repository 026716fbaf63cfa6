"""romandask: a joint synthetic sky survey of the Roman Space Telescope and Rubin's LSST, as lazy dask graphs."""

from importlib.metadata import version as _version

from threadpoolctl import threadpool_limits

from romandask.coadds import coadds
from romandask.cutouts import cutouts
from romandask.detections import detections, objects
from romandask.exposures import exposures
from romandask.flow import run_on
from romandask.matches import matches
from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.pipeline import Pipeline, load_pipeline
from romandask.pointings import pointings
from romandask.psfs import psfs
from romandask.statistics import statistics
from romandask.survey import Survey
from romandask.survey import open_survey as open  # noqa: A004
from romandask.truth import truth
from romandask.truth_index import truth_index

__version__ = _version("romandask")
# with more threads linear algebra rounds its sums otherwise, and pixels would depend on how many cores there are
threadpool_limits(limits=1, user_api="blas")

__all__ = [
    "Cone",
    "Pipeline",
    "Region",
    "Survey",
    "UserError",
    "coadds",
    "cutouts",
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
