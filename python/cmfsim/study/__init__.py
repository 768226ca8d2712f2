"""Many cases, and many trials of one: cohorts by several models, and moved landmarks."""

from cmfsim.deferred import deferred

__getattr__, __dir__, __all__ = deferred(
    __name__,
    {
        "cohort": (
            "CaseOutcome",
            "StudyReport",
            "run_study",
        ),
        "trials": (
            "LandmarkTrial",
            "SensitivityReport",
            "landmark_trials",
            "sensitivity",
        ),
    },
)
