"""Fixtures that every test may use."""

from collections.abc import Iterator
from pathlib import Path

import hypothesis
import kinematic_jobs
import pytest
import torch
from pretended_cuda import CUDA, PretendedCuda

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


@pytest.fixture(params=["pretended", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """A GPU: a pretended one on every machine, and the real one where there is one."""
    if request.param == "pretended":
        with PretendedCuda():
            yield CUDA
    elif torch.cuda.is_available():
        yield torch.device("cuda", 0)
    else:
        pytest.skip("needs a CUDA device")


@pytest.fixture
def robot_job(tmp_path: Path) -> Job:
    """A carried sensor in a room; two frames, images of one value."""
    return kinematic_jobs.robot_job(tmp_path)


@pytest.fixture
def hand_job() -> Job:
    """No robot, two frames."""
    return kinematic_jobs.hand_job()
