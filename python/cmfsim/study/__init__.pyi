from cmfsim.study.cohort import CaseOutcome as CaseOutcome
from cmfsim.study.cohort import StudyReport as StudyReport
from cmfsim.study.cohort import run_study as run_study
from cmfsim.study.trials import LandmarkTrial as LandmarkTrial
from cmfsim.study.trials import SensitivityReport as SensitivityReport
from cmfsim.study.trials import landmark_trials as landmark_trials
from cmfsim.study.trials import sensitivity as sensitivity
