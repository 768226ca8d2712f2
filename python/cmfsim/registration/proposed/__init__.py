"""Landmarks found without a person: each site where its own definition holds, with a confidence."""

from cmfsim.registration.proposed.proposal import landmarks_from, measured_biases
from cmfsim.registration.proposed.template_head import TemplateHead

__all__ = ["TemplateHead", "landmarks_from", "measured_biases"]
