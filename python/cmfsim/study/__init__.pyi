from cmfsim.study.cohort import CaseOutcome, StudyReport, run_study
from cmfsim.study.trials import LandmarkTrial, SensitivityReport, landmark_trials, sensitivity

__all__ = [
    "CaseOutcome",
    "LandmarkTrial",
    "SensitivityReport",
    "StudyReport",
    "landmark_trials",
    "run_study",
    "sensitivity",
]
