"""Where the project's own robots are."""

from pathlib import Path

from torchcal.errors import TorchcalError, choices


def robot_folder(name: str) -> Path:
    """The folder of one of the project's robots, such as ``arm``: its URDF, meshes and README.

    Raises:
        TorchcalError: If there is no such robot.
    """
    package = Path(__file__).resolve().parents[1]
    installed, checkout = package / "robots", package.parent / "robots"
    robots = installed if installed.is_dir() else checkout
    folder = robots / name
    if not folder.is_dir():
        there = (each.name for each in robots.glob("*/") if each.is_dir())
        raise TorchcalError(f"{robots}: found no robot {name!r}; expected {choices(there)}")
    return folder
