"""Muscle templates: loaded, checked, made from a phantom or an atlas, and morphed to patients."""

from cmfsim.template.bodyparts3d import WHERE, import_bodyparts3d
from cmfsim.template.built_in import template_names, template_path
from cmfsim.template.checking import check_template
from cmfsim.template.from_phantom import phantom_muscle, phantom_template
from cmfsim.template.morphing import MorphedMusculature
from cmfsim.template.muscle_template import MuscleTemplate
from cmfsim.template.skull_reference import joined_surface

__all__ = [
    "WHERE",
    "MorphedMusculature",
    "MuscleTemplate",
    "check_template",
    "import_bodyparts3d",
    "joined_surface",
    "phantom_muscle",
    "phantom_template",
    "template_names",
    "template_path",
]
