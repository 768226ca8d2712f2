from cmfsim.study.cohort import CaseOutcome, StudyReport, run_study
from cmfsim.study.evaluation import EVALUATION_FILE, CaseEvaluation, evaluate
from cmfsim.study.prediction import predict, predict_models
from cmfsim.study.trials import LandmarkTrial, SensitivityReport, landmark_trials, sensitivity

__all__ = [
    "EVALUATION_FILE",
    "CaseEvaluation",
    "CaseOutcome",
    "LandmarkTrial",
    "SensitivityReport",
    "StudyReport",
    "evaluate",
    "landmark_trials",
    "predict",
    "predict_models",
    "run_study",
    "sensitivity",
]
