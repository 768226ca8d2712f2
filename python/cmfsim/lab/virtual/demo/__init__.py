"""The embedded case: a synthetic head with its operation and its true face."""

from cmfsim.lab.virtual.demo.patient import DemoCase, read_demo_truth, write_demo_case

__all__ = ["DemoCase", "read_demo_truth", "write_demo_case"]
