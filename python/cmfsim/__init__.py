"""The face after cranio-maxillofacial surgery, by the mass-tensor model.

Lengths are mm, forces N, moduli MPa; internal forces are K u. Importing this package and solving
with it needs numpy alone. Research software: it is not a medical device.

By task, from the whole to its parts (docs/python.md names everything that belongs to each):

case        init_case, Case, examine, predict, predict_models, evaluate, build_model
planning    make_planning_page, planning_model, plan_for_face, make_splint, clinical_figures
images      read_image, segment_head, read_surface, repair_surface, anatomy_from_surfaces
landmarks   read_landmarks, propose_landmarks, match_landmarks, icp, register_volumes
osteotomies place_procedure, free_cut, cut_bones, segments_from_surfaces
plans       planned_motion, clinical_motion, rigid_motion, read_transform, achieved_plan
mesh        tissue_level, mesh_from_level, from_meshio, classify_nodes, segment_data
muscles     MuscleTemplate, equivalent_material, TissueModuli
mechanics   Scene, solve_scene, TetMesh, Tissue, MassTensors, Boundary, StaticSolver
trust       predict_with_band, calibrate, sensitivity, expected_error
outcome     compare_skins, compare_models, run_study, run_variants, wilcoxon_test
synthetic   make_head, write_phantom_case, virtual_population, run_benchmark, frontier
errors      CmfsimError, CaseError, ImageError, LandmarkError, MeshError, SolverError

The same work is done on three levels: a case on disk (`predict`), a patient made step by step
(`predict_patient`), and a scene of plain arrays (`solve_scene`).
"""

from cmfsim.deferred import deferred

# A public name is a line of __init__.pyi.
__getattr__, __dir__, __all__ = deferred(__name__, __file__)
