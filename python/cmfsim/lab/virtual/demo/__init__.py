"""The embedded case: a synthetic class III head with its operation and its true face."""

from cmfsim.lab.virtual.demo.patient import DemoCase, write_demo_case
from cmfsim.lab.virtual.demo.truth import DemoTruth, read_demo_truth

__all__ = ["DemoCase", "DemoTruth", "read_demo_truth", "write_demo_case"]
