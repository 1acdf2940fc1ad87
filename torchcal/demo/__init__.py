"""A robot, a cell and a recording with known truth, made from nothing."""

from torchcal.demo.recording import DemoTruth as DemoTruth
from torchcal.demo.recording import make_demo as make_demo
from torchcal.demo.robots import robot_folder as robot_folder
