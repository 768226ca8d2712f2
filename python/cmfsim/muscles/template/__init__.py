"""Muscle templates: loaded, checked, made from an atlas, and morphed to patients."""

from cmfsim.muscles.template.bodyparts3d import WHERE as WHERE
from cmfsim.muscles.template.bodyparts3d import import_bodyparts3d as import_bodyparts3d
from cmfsim.muscles.template.checking import check_template as check_template
from cmfsim.muscles.template.checking import template_names as template_names
from cmfsim.muscles.template.checking import template_path as template_path
from cmfsim.muscles.template.muscle_template import MorphedMusculature as MorphedMusculature
from cmfsim.muscles.template.muscle_template import MuscleTemplate as MuscleTemplate
