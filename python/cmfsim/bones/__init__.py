"""Bone segments from bones: cutting planes, standard procedures, the pieces and their surfaces."""
