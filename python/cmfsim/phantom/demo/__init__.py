"""The embedded case: a made head of class III with its operation, and what is known of its face."""

from cmfsim.phantom.demo.patient import DemoCase, write_demo_case
from cmfsim.phantom.demo.truth import DemoTruth, read_demo_truth

__all__ = ["DemoCase", "DemoTruth", "read_demo_truth", "write_demo_case"]
