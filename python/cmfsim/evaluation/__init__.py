"""Predictions against the post-operative skin: partners, distances, regions, tests (paper 3.2)."""

from cmfsim.evaluation.comparison import SkinComparison, compare_skins
from cmfsim.evaluation.conformal import calibrate, cases_needed, covered_interval, region_scores
from cmfsim.evaluation.models import (
    NO_CHANGE,
    WHOLE,
    ErrorTable,
    Improvement,
    ModelComparison,
    compare_models,
    error_table,
)
from cmfsim.evaluation.regions import REGIONS, skin_regions, unmoved_regions
from cmfsim.evaluation.statistics import (
    LEAST_PAIRS,
    DistanceStatistics,
    PairedChange,
    PairedTest,
    distance_statistics,
    paired_change,
    wilcoxon_test,
)
from cmfsim.evaluation.unmoved import ThicknessChange, compare_unmoved, fitted_thickness
from cmfsim.values.landmark_sites import SKIN_LANDMARKS

__all__ = [
    "LEAST_PAIRS",
    "NO_CHANGE",
    "REGIONS",
    "SKIN_LANDMARKS",
    "WHOLE",
    "DistanceStatistics",
    "ErrorTable",
    "Improvement",
    "ModelComparison",
    "PairedChange",
    "PairedTest",
    "SkinComparison",
    "ThicknessChange",
    "calibrate",
    "cases_needed",
    "compare_models",
    "compare_skins",
    "compare_unmoved",
    "covered_interval",
    "distance_statistics",
    "error_table",
    "fitted_thickness",
    "paired_change",
    "region_scores",
    "skin_regions",
    "unmoved_regions",
    "wilcoxon_test",
]
