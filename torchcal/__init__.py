"""Tells a robot where its model of the world is wrong."""

from importlib.metadata import version

__version__ = version("torchcal")
