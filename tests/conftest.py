"""Fixtures that every test may use."""

from pathlib import Path

import hypothesis
import kinematic_jobs
import pytest
import torch

from torchcal.model.job import Job

hypothesis.settings.register_profile(
    "quick", max_examples=100, deadline=None, derandomize=True, database=None
)
hypothesis.settings.register_profile(
    "long", max_examples=10_000, deadline=None, suppress_health_check=list(hypothesis.HealthCheck)
)
hypothesis.settings.load_profile("quick")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture
def rng() -> torch.Generator:
    """Random numbers that are the same in every run."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def shared() -> Path:
    """The folder with real recordings beside the repository."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the real recordings in {SHARED}")
    return SHARED


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that is there."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return torch.device(request.param)


@pytest.fixture
def robot_job(tmp_path: Path) -> Job:
    """A carried sensor in a room; two frames, images of one value."""
    return kinematic_jobs.robot_job(tmp_path)


@pytest.fixture
def hand_job() -> Job:
    """No robot, two frames."""
    return kinematic_jobs.hand_job()
