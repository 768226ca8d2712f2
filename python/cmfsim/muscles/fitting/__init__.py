"""Muscles moved into the tissue of a patient: between bone and skin, out of air."""

from cmfsim.muscles.fitting.fit import FittedMuscle, MuscleFit, fit_muscles

__all__ = ["FittedMuscle", "MuscleFit", "fit_muscles"]
