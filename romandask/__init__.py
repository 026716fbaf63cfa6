"""romandask: a joint synthetic sky survey of the Roman Space Telescope and Rubin's LSST, as lazy dask graphs."""

from importlib.metadata import version as _version

from threadpoolctl import threadpool_limits

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
# the rounding of sums in linear algebra depends on the number of threads; pixels must not depend on the number of cores
threadpool_limits(limits=1, user_api="blas")

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
