"""Names of jobs are clear, stable and never two for one folder."""

from pathlib import Path

import pytest

from torchcal.errors import TorchcalError
from torchcal.fleet.ledger import find_jobs, fingerprint, read_record


def job(*parts: str) -> Path:
    file = Path(*parts)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("")
    return file


@pytest.fixture
def root(tmp_path) -> str:
    return str(tmp_path / "fleet")


def test_jobs_below_a_folder_are_named_by_their_paths(root):
    files = [job(root, "r1", "monday", "job.toml"), job(root, "r2", "monday", "job.toml")]
    assert find_jobs([Path(root)]) == dict(zip(("r1/monday", "r2/monday"), files, strict=True))


def test_job_files_are_named_by_their_folders_or_by_themselves(root):
    files = [job(root, "monday", "job.toml"), job(root, "cell.toml")]
    assert find_jobs(files) == {"monday": files[0], "cell": files[1]}


def test_a_folder_that_is_a_job_is_named_by_itself(root):
    file = job(root, "job.toml")
    assert find_jobs([Path(root)]) == {"fleet": file}


def test_the_same_job_twice_is_one_job(root):
    file = job(root, "monday", "job.toml")
    assert list(find_jobs([file, Path(root)])) == ["monday"]


def test_half_written_folders_hold_no_jobs(root):
    job(root, "monday", "job.toml")
    job(root, ".tuesday.partial-0123abcd", "job.toml")
    assert list(find_jobs([Path(root)])) == ["monday"]


def test_two_jobs_of_one_name_are_refused(root):
    files = [job(root, "r1", "monday", "job.toml"), job(root, "r2", "monday", "job.toml")]
    with pytest.raises(TorchcalError, match=r"monday.*give the folder above both"):
        find_jobs(files)


def test_results_would_not_lie_in_each_other(root):
    job(root, "r1", "job.toml")
    job(root, "r1", "monday", "job.toml")
    with pytest.raises(TorchcalError, match="r1 and r1/monday"):
        find_jobs([Path(root)])


@pytest.mark.parametrize(("place", "found"), [("none", "nothing"), ("empty", "no job.toml")])
def test_a_place_without_a_job_is_a_mistake(tmp_path, place, found):
    (tmp_path / "empty").mkdir()
    with pytest.raises(TorchcalError, match=f"found {found}"):
        find_jobs([tmp_path / place])


def test_the_fingerprint_follows_contents_sizes_and_seed(root):
    file, image = job(root, "job.toml"), job(root, "0001.png")
    first = fingerprint(file, [image], 0)
    assert fingerprint(file, [image], 0) == first
    assert fingerprint(file, [image], 1) != first
    image.write_text("longer")
    changed = fingerprint(file, [image], 0)
    assert changed != first
    file.write_text("# other")
    assert fingerprint(file, [image], 0) != changed


def test_a_record_without_a_result_is_none(tmp_path):
    (tmp_path / "batch.json").write_text("{}")
    assert read_record(tmp_path) is None
