"""The open benchmark: displacements of the skin, by any method, scored on virtual patients."""

from cmfsim.lab.benchmark.patients import SkinPrediction as SkinPrediction
from cmfsim.lab.benchmark.patients import read_skin_prediction as read_skin_prediction
from cmfsim.lab.benchmark.patients import write_skin_prediction as write_skin_prediction
from cmfsim.lab.benchmark.running import run_benchmark as run_benchmark
from cmfsim.lab.benchmark.scores import BenchmarkTable as BenchmarkTable
