"""The paper's procedure: estimate, compare, update."""

from torchcal.calibrate.check import check as check
from torchcal.calibrate.pipeline import calibrate as calibrate
from torchcal.calibrate.pipeline import predict as predict
