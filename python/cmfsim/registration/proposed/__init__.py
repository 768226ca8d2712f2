"""Landmarks found without a person: each site where its own definition holds, with a confidence."""

from cmfsim.registration.proposed.proposal import landmarks_from as landmarks_from
from cmfsim.registration.proposed.proposal import measured_biases as measured_biases
from cmfsim.registration.proposed.template_head import TemplateHead as TemplateHead
