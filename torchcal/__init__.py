"""Tells a robot where its model of the world is wrong, from range images and a CAD model.

Every command is a call or two of what stands here::

    torchcal calibrate    read_job, calibrate, write_results
    torchcal follow       read_recording, follow
    torchcal render       read_job, predict
    torchcal check        read_job, check
    torchcal batch        as calibrate, for many jobs
    torchcal import       import_recording
    torchcal view         read_result, decide; of a job: read_job, calibrate
    torchcal update       read_result, decide
    torchcal demo         make_demo, then as calibrate
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from torchcal.calibrate import calibrate as calibrate
from torchcal.calibrate import check as check
from torchcal.calibrate import predict as predict
from torchcal.calibrate.check import foresee as foresee
from torchcal.calibrate.check_result import Foresight as Foresight
from torchcal.calibrate.check_result import JobCheck as JobCheck
from torchcal.calibrate.compare import reclassified as reclassified
from torchcal.calibrate.decisions import Decision as Decision
from torchcal.calibrate.decisions import Transaction as Transaction
from torchcal.calibrate.element_pose import find_element_poses as find_element_poses
from torchcal.calibrate.element_result import ElementPoses as ElementPoses
from torchcal.calibrate.element_result import ElementStatus as ElementStatus
from torchcal.calibrate.element_search import ElementSearch as ElementSearch
from torchcal.calibrate.follow import follow as follow
from torchcal.calibrate.kept_result import FramePlace as FramePlace
from torchcal.calibrate.kept_result import Result as Result
from torchcal.calibrate.kept_result import kept as kept
from torchcal.calibrate.localisation import Localisation as Localisation
from torchcal.calibrate.localisation import Matches as Matches
from torchcal.calibrate.localisation import Rival as Rival
from torchcal.calibrate.localisation import StagePose as StagePose
from torchcal.calibrate.localise import localise as localise
from torchcal.calibrate.localise import localise_pixels as localise_pixels
from torchcal.calibrate.parameters import Parameters as Parameters
from torchcal.calibrate.pipeline import build_job_scene as build_job_scene
from torchcal.calibrate.result import AddedObject as AddedObject
from torchcal.calibrate.result import Alternative as Alternative
from torchcal.calibrate.result import Calibration as Calibration
from torchcal.calibrate.result import Change as Change
from torchcal.calibrate.result import Estimate as Estimate
from torchcal.calibrate.result import Evidence as Evidence
from torchcal.calibrate.result import FrameComparison as FrameComparison
from torchcal.calibrate.result import NextView as NextView
from torchcal.calibrate.result import ObjectVerdict as ObjectVerdict
from torchcal.calibrate.result import PixelClass as PixelClass
from torchcal.calibrate.result import Proposal as Proposal
from torchcal.calibrate.result import Status as Status
from torchcal.calibrate.result import UnobservableDirection as UnobservableDirection
from torchcal.calibrate.result import Update as Update
from torchcal.calibrate.result import Verdict as Verdict
from torchcal.calibrate.result_folder import read_result as read_result
from torchcal.calibrate.site import Site as Site
from torchcal.calibrate.tracked import Tracked as Tracked
from torchcal.calibrate.tracked import TrackStatus as TrackStatus
from torchcal.calibrate.tracker import Tracker as Tracker
from torchcal.calibrate.wander import Wander as Wander
from torchcal.demo import make_demo as make_demo
from torchcal.errors import JobError as JobError
from torchcal.errors import TorchcalError as TorchcalError
from torchcal.geometry import se3 as se3
from torchcal.geometry.projection import Pinhole as Pinhole
from torchcal.geometry.projection import Projection as Projection
from torchcal.geometry.projection import Spherical as Spherical
from torchcal.geometry.projection import pixel_grid as pixel_grid
from torchcal.match.detection import every_candidate as every_candidate
from torchcal.match.detection import nearest_candidate as nearest_candidate
from torchcal.match.elements import Elements as Elements
from torchcal.match.features import Features as Features
from torchcal.match.features import LineKind as LineKind
from torchcal.match.features import Lines as Lines
from torchcal.match.features import Planes as Planes
from torchcal.match.features import Vertices as Vertices
from torchcal.match.image.features import image_features as image_features
from torchcal.match.minimal_sets import Hypotheses as Hypotheses
from torchcal.match.pairs import Pairs as Pairs
from torchcal.match.prior_gate import Prior as Prior
from torchcal.model.job import Frame as Frame
from torchcal.model.job import Job as Job
from torchcal.model.job import PosePrior as PosePrior
from torchcal.model.job import RangePrior as RangePrior
from torchcal.model.range_image import RangeImage as RangeImage
from torchcal.model.read_job import Recording as Recording
from torchcal.model.read_job import read_job as read_job
from torchcal.model.read_job import read_recording as read_recording
from torchcal.model.read_sensor import preset_sensor as preset_sensor
from torchcal.model.recordings.import_recording import Imported as Imported
from torchcal.model.recordings.import_recording import import_recording as import_recording
from torchcal.model.recordings.recorded import Selection as Selection
from torchcal.model.robot import Robot as Robot
from torchcal.model.robot import load_robot as load_robot
from torchcal.model.scene import Scene as Scene
from torchcal.model.scene import Surface as Surface
from torchcal.model.scene import body_poses as body_poses
from torchcal.model.scene import build_scene as build_scene
from torchcal.model.sensor import Drift as Drift
from torchcal.model.sensor import Noise as Noise
from torchcal.model.sensor import Sensor as Sensor
from torchcal.model.urdf import write_urdf as write_urdf
from torchcal.model.world import World as World
from torchcal.model.world import WorldObject as WorldObject
from torchcal.model.world import load_world as load_world
from torchcal.model.world import write_world as write_world
from torchcal.render.synthesis import Synthesis as Synthesis
from torchcal.render.synthesis import synthesise as synthesise

if TYPE_CHECKING:
    from torchcal.cli.result_files import check_dict as check_dict
    from torchcal.cli.result_files import foresight_dict as foresight_dict
    from torchcal.cli.result_files import result_dict as result_dict
    from torchcal.cli.result_files import write_results as write_results
    from torchcal.display.decided import decide as decide
    from torchcal.display.edges import edges_figure as edges_figure
    from torchcal.display.summary import next_view_words as next_view_words

__version__ = version("torchcal")

_WRITERS = {
    "check_dict": "torchcal.cli.result_files",
    "foresight_dict": "torchcal.cli.result_files",
    "result_dict": "torchcal.cli.result_files",
    "write_results": "torchcal.cli.result_files",
    "decide": "torchcal.display.decided",
    "edges_figure": "torchcal.display.edges",
    "next_view_words": "torchcal.display.summary",
}
"""Their rooms draw the pictures and the report, which not every program wants."""


def __getattr__(name: str) -> object:
    if name not in _WRITERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_WRITERS[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_WRITERS})
