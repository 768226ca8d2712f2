"""The open benchmark: displacements of the skin, by any method, scored on virtual patients."""

from cmfsim.lab.benchmark.patients import (
    SkinPrediction,
    read_skin_prediction,
    write_skin_prediction,
)
from cmfsim.lab.benchmark.running import run_benchmark
from cmfsim.lab.benchmark.tables import BenchmarkTable

__all__ = [
    "BenchmarkTable",
    "SkinPrediction",
    "read_skin_prediction",
    "run_benchmark",
    "write_skin_prediction",
]
