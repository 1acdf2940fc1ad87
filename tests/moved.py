"""What lies on one device, on another one."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchcal.model.robot import Robot


def moved(value: Any, device: torch.device) -> Any:
    """A value with all its tensors on a device; a robot's lie where they are asked for."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, Robot):
        return value
    if isinstance(value, tuple | list):
        return type(value)(moved(each, device) for each in value)
    if isinstance(value, dict):
        return {key: moved(each, device) for key, each in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
        return replace(value, **{name: moved(part, device) for name, part in parts.items()})
    return value
