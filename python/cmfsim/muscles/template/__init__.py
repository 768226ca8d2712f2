"""Muscle templates: loaded, checked, made from a phantom or an atlas, and morphed to patients."""

from cmfsim.muscles.template.bodyparts3d import WHERE, import_bodyparts3d
from cmfsim.muscles.template.built_in import template_names, template_path
from cmfsim.muscles.template.checking import check_template
from cmfsim.muscles.template.from_phantom import phantom_muscle, phantom_template
from cmfsim.muscles.template.morphing import MorphedMusculature
from cmfsim.muscles.template.muscle_template import MuscleTemplate

__all__ = [
    "WHERE",
    "MorphedMusculature",
    "MuscleTemplate",
    "check_template",
    "import_bodyparts3d",
    "phantom_muscle",
    "phantom_template",
    "template_names",
    "template_path",
]
