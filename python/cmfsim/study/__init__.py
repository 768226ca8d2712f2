"""Cases through every stage: prediction, evaluation, sensitivity, and cohorts of many cases."""

from cmfsim.deferred import deferred

__getattr__, __dir__, __all__ = deferred(
    __name__,
    {
        "cohort": (
            "CaseOutcome",
            "StudyReport",
            "run_study",
        ),
        "evaluation": (
            "EVALUATION_FILE",
            "CaseEvaluation",
            "evaluate",
        ),
        "prediction": (
            "predict",
            "predict_models",
        ),
        "trials": (
            "LandmarkTrial",
            "SensitivityReport",
            "landmark_trials",
            "sensitivity",
        ),
    },
)
