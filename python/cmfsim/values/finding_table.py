"""What is checked: every code of a finding with its severity, meaning, reason and remedy.

A finding takes from it what it does not state itself, and `scripts/make_checks_page.py` writes
docs/checks.md from it. Names in braces are filled in by a finding.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

# What is filled in: a name, and how it is written.
BLANK = re.compile(r"\{(\w+)(?:!r)?(?::[^}]*)?\}")


@dataclass(frozen=True)
class FindingKind:
    """What findings of one code have in common.

    severity: "error", "warning" or "note"; several joined by " or " where it depends on the size.
    meaning, why, fix: The fact, its effect on the result, and what to do.
    """

    severity: str
    meaning: str
    why: str
    fix: str


def filled(text: str, facts: Mapping[str, object]) -> str:
    """A text of the table with the facts in it, and … for those that are not given."""
    return BLANK.sub(lambda m: m[0].format_map(facts) if m[1] in facts else "…", text)


# One row for each code.
# fmt: off
FINDING_KINDS: Mapping[str, FindingKind] = MappingProxyType({
    "achieved-piece-off": FindingKind("warning or note", "a piece of a segment is off the post-operative bone", "the piece was not used for the motion but moves with the rest of the segment, so the face over it may be wrong by that distance", "if that piece was cut, make it a separate segment; otherwise check whether bone was removed"),
    "bite-odd": FindingKind("warning", "the plan takes the bone at the lower front teeth from … mm … that at the upper ones to … mm … it (infradentale, supradentale)", "operations on the jaws make bites better; one of the motions is not as it was meant", "check whether {better}; nothing to do if this bite is meant"),
    "bite-scan-symmetric": FindingKind("warning", "the mirror image of a scan fits the teeth as well", "if a program has mirrored the scan, left is right in the bite, and nothing else shows it", "compare a tooth of one side in the scan with the CT, such as a filling, or a gap"),
    "bodyparts3d-parts": FindingKind("warning or note", "a file of BodyParts3D is unknown, broken, incomplete, or named for another", "the atlas is the source of the template of muscles", "nothing to do; check the muscle"),
    "bone-islands": FindingKind("note", "… pieces of bone below … mm³ each, … cm³ together, were dropped", "they are thin bone, calcified vessels or noise, and are treated as soft tissue", "lower bone_threshold or island if a wanted piece is missing"),
    "bone-outside-skin": FindingKind("warning", "bone lies outside the skin", "no tissue covers it, so the face cannot be predicted there", "check that skin and bone are from one patient and in one frame; if the spine protrudes, cut the neck lower"),
    "bone-overlap": FindingKind("warning", "… of bone … lies within bone …", "the case contains the same bone twice; if one copy moves and the other stays, tissue is attached to both", "cut {name} out of {other_name}, or remove the file and define the cut in [[osteotomies]]"),
    "bone-removed": FindingKind("warning or note", "… mm² of … about (…) mm are missing after the operation, by up to … mm: this counts as removed bone, not as motion", "bone that is ground away does not pull the tissue over it; that tissue follows the rest of the segment; {used}", "check the bone there; if it was pushed in (fracture, impaction), define that part as a separate bone"),
    "bone-weak": FindingKind("warning", "compact bone reaches only … HU, so a threshold of … HU misses much of it", "thin bone is lost and the skull gets holes", "try bone_threshold = {threshold:.0f}"),
    "chin-short": FindingKind("warning", "the chin is … mm high, so the cut passes … mm below the estimated roots instead of … mm", "the piece is low, and the cut is near the roots", "check the cut in the picture; set clearance, or give the plane"),
    "clefts-left-out": FindingKind("note", "… tets of … mm³ in total are in the clefts between segments and were removed: their distances from two segments add up to less than … mm", "there is air between the tooth rows, and at a cut the tissue is lifted off the bone; tets stretched across would be inverted and hold the bones back", "set cleft in [mesh] to another width, or to 0 to keep all tissue"),
    "contact-sheet": FindingKind("warning or note", "the contact sheet of an arch does not suit the bone or the tets", "lips and cheeks would be attached to the teeth there, or sliding may not converge", "check the landmarks of the arch and the bone in anatomy.png, or set contact_surface = \"bone\" in [node_kinds]"),
    "contact-slipped-far": FindingKind("warning", "… sliding … slipped further than bones moved, at most … before the operation", "tissue slipped round an edge of the bone; the plan may have another equilibrium, in which the face nearby is different", "compare the face nearby with that of a slightly smaller motion, or end the sliding region before the edge ([node_kinds])"),
    "contact-stopped": FindingKind("warning", "contact stopped before its tolerance was reached", "this exceeds the tolerance, but is too small to be visible in the face", "allow more contact_iterations or a larger contact_tolerance, or smooth the surface"),
    "correspondence-folds": FindingKind("warning", "a map between landmarks folds", "points that are paired there do not correspond anatomically", "check the landmarks: one may be swapped with another, or placed at a different point of the face"),
    "crushed-left-out": FindingKind("note", "… tets of … mm³ in total would keep less than … of their volume between segments that move towards each other, and were removed", "bones leave this tissue no room; its tets would be inverted and push the rest aside", "check that the plan does not move bones into each other; kinematics linear, or cleft 0 in [mesh], keeps all tissue"),
    "ct-coarsened": FindingKind("note", "the head was resampled at … mm", "a finer grid would have more than most_voxels = {most_voxels} voxels", "crop the image to the face, or raise most_voxels"),
    "ct-cupping": FindingKind("warning", "soft tissue is … HU darker in the middle of the head than near its surface, as is typical of cone-beam scanners; the values were scaled between air and soft tissue to compensate", "a single threshold finds too much bone near the skin and too little in the middle", "check the bone visually; a CT from a fan-beam scanner does not have this effect"),
    "ct-cut-off": FindingKind("warning or note", "a part of the head is cut off: skin or bone meets a border of the image, or padding", "the surface is closed by a plane there, and the prediction near it is meaningless", "use an image that shows the whole face, or exclude that region from the evaluation"),
    "ct-flipped": FindingKind("error", "the head is upside down, or the face points backwards: the image is flipped, or its header is wrong", "front and back, or up and down, would be swapped; left and right may be swapped as well, but an image cannot show that", "export the image again with its orientation, and check left and right"),
    "ct-noise": FindingKind("warning", "the noise of the image is … HU in voxels of the working grid; bone was found in the image smoothed by a Gaussian of … voxels", "thin bone, as in the orbits and sinus walls, may be lost, or appear where there is none", "use a smoother reconstruction (kernel) of the same scan, and check thin bone visually"),
    "ct-not-hu": FindingKind("warning", "the image is not in HU", "thresholds of skin and bone are in HU", "check skin and bone visually, or set skin_threshold and bone_threshold"),
    "ct-saturated": FindingKind("warning or note", "the image is cut off at … HU, but metal is recognised by … HU…", "metal, enamel and dense bone have the same value there…", "export the CT with its whole range of values, or set metal_threshold in [image]"),
    "ct-spacing-coarse": FindingKind("warning", "slices or voxels are … mm apart", "thin bone, lips and eyelids are lost between slices more than {most:g} mm apart; surfaces are a millimetre less accurate", "use the thin-slice reconstruction of the same scan"),
    "ct-unusual": FindingKind("warning", "the image has air as a CT does, but not the tissue of a living head: …", "phantoms and cadavers may have other densities: skin and bone may be placed wrongly", "check skin and bone visually; set skin_threshold and bone_threshold in [image]"),
    "cut-of-joined-jaws": FindingKind("warning", "… is cut from a skull whose jaws are not separated; it ends at the edges of the upper teeth: bone below stays where it is, but the front of the rami may move with it", "the lower jaw is not there as a bone of its own: teeth in contact may be divided some millimetres off, and tissue over the lower jaw cannot follow a motion of it", "place landmarks of both tooth rows, or give surfaces of both bones"),
    "cut-options": FindingKind("error", "a cut cannot be placed with these options", "the cut cannot be placed", "correct the option, or remove it"),
    "cut-site-estimated": FindingKind("warning", "… is placed with … estimated from … other landmarks and an average head; they may be … mm off", "the landmarks were not found or placed; the cut may lie some millimetres off", "check the cut in the picture, and place these landmarks if the image shows the bone"),
    "cut-small-head": FindingKind("warning", "the head has … times the size of an average adult's, and le_fort_1 runs … mm above roots of an adult's length", "a child's roots are shorter, and unerupted teeth lie above them: for its face, the cut lies higher than an adult's", "check the cut in the picture, and give height in [[osteotomies]] as the image shows the roots"),
    "cuts-both-le-fort": FindingKind("warning", "Le Fort I and Le Fort III are cut together", "a plan needs a motion for both pieces: the maxilla does not follow the midface, nor the midface the maxilla", "remove the cut that is not meant; if both are, give both segments a motion"),
    "dicom-folders": FindingKind("note", "the slices of the series lie in … folders: …", "a series is known by its UID, not by its folder", "nothing to do"),
    "dicom-frames-assumed": FindingKind("warning", "the file states the place of its first frame alone; the … frames were placed one after the other along its normal, …", "if they run the other way, the head is mirrored: right is left or top is bottom", "compare left and right, and the height of the head, with the patient; or export the series as one file per slice"),
    "dicom-series": FindingKind("warning", "… series in the folder; the largest CT, …, was chosen from: …", "another series may be the right one", "write series in [image] if another one is meant"),
    "dicom-skipped": FindingKind("warning or note", "files of a DICOM folder were skipped: localisers, copies, files that are damaged, absent or not DICOM", "one may be a slice of this series", "check that none of these is a slice of the volume; copy or fetch what is damaged or absent"),
    "dicom-tilted": FindingKind("warning", "slices are tilted against their stack; they were resampled by their positions", "if another program wrote the positions without the tilt, the head is sheared", "export the original series from the scanner or archive, and check the shape of the head visually"),
    "dicom-uneven": FindingKind("warning", "slices are … mm apart, from … to … mm: …; resampled by their positions", "shapes are less certain where slices are further apart", "use a reconstruction with evenly spaced slices if there is one"),
    "edge-length-coarse": FindingKind("warning or note", "… of the skin of the region lies closer to bone than an edge of … mm, … mm at …", "layers thinner than an edge are lost or too stiff…", "use a smaller edge_length, or refine = true"),
    "field-ignored": FindingKind("warning", "a field of the file was ignored: …", "the program that wrote it made an error there; all else in it agrees", "compare what was read with the patient, or export it again"),
    "file-missing": FindingKind("error", "a file that the case or a template names does not exist, is empty, or cannot be read", "the work cannot go on without it", "put the file there, or correct its path or name"),
    "frame-turned": FindingKind("error or warning", "according to its landmarks, the head is turned: RAS read as LPS, upside down, backwards, or tilted by more than 60°", "left and right, front and back would be swapped", "check the axes of the program that wrote the files: LPS is left, posterior, superior"),
    "frame-unstated": FindingKind("warning or note", "an image or a file of landmarks does not state its frame", "if the assumed frame is wrong, left and right are swapped, or front and back", "state the frame in the file, and check left and right"),
    "hollow-left-out": FindingKind("note", "… cm³ behind bone were removed from the tissue", "the cranial cavity and closed sinuses do not deform with the face", "nothing to do; lower foramen_radius if tissue of the face is missing"),
    "image-oblique": FindingKind("warning or note", "the image's axes are turned or sheared against the patient's; it was resampled", "all stages need a grid along the patient's axes", "nothing to do"),
    "image-template-space": FindingKind("error or warning", "its sform (code …) leads to the space of a template…", "lengths in the space of a template differ from those of the patient", "use the image in the scanner's space"),
    "image-unit-unstated": FindingKind("note", "it states no unit of length: voxels were taken as … mm", "every length of the head depends on it", "compare a distance in the image with one on the patient, or export with units of mm"),
    "input-unreadable": FindingKind("error", "a file of the case cannot be read: image, surface, landmarks, transform, template or face after the operation", "nothing can be built from it", "export it again from the program that made it"),
    "inverted-tets": FindingKind("warning", "… of … tets are inverted at equilibrium; the worst is tet …, at … of its volume", "tissue cannot turn inside out: forces and displacements around these tets are wrong", "check whether the plan moves bones into each other, and build the case for this plan and these kinematics, which removes tissue that it crushes; if kinematics is \"corotational\", also try \"hyperelastic\", which resists inversion"),
    "jaw-doubtful": FindingKind("warning", "the part taken for the mandible is doubtful, or cannot be it", "landmarks of jaws and teeth are on it, and segments are cut from it", "place the landmarks of the skull by hand and name the file under [landmarks]: the jaws are then separated by them"),
    "jaws-not-parted": FindingKind("warning", "the mandible could not be separated from the skull: …", "mandible and cranium would move together", "give skull landmarks (menton, gonion_L, gonion_R, supradentale, infradentale, …) or ready surfaces of both bones"),
    "jaws-parted-by-shape": FindingKind("note", "the mandible was separated from the skull by shape: the landmarks of both tooth rows are not given", "the cut between the tooth rows may be some millimetres off", "give skull landmarks"),
    "jaws-separated-again": FindingKind("warning or note", "the mandible was separated by shape, and again by the landmarks found, or not again because they are inconsistent", "with shape alone, the cut between the tooth rows is some millimetres off", "place the landmarks of the skull by hand and name the file under [landmarks]"),
    "joint-left": FindingKind("warning", "the joint head of … at … leaves its joint by … mm", "a jaw that is moved as a whole turns about its joints; what is moved against them is cut off first, and the tissue over the angle of the jaw stays", "is a sagittal split missing? Add [[osteotomies]] with procedure = \"bsso\" and move mandible_body; otherwise check the motion"),
    "landmark-asymmetric": FindingKind("warning", "a pair of landmarks is not symmetric", "{placed}; overall asymmetry is taken into account, so one of them is misplaced or the bone is deformed there", "check both sides in 3D Slicer; place it again, or keep it if the bone is asymmetric there"),
    "landmark-disagrees": FindingKind("warning", "a landmark lies far from where the others place it", "each pulls nearby muscles along, and makes its neighbours look misplaced", "place it again"),
    "landmark-doubtful": FindingKind("warning", "… (…) at (…, …, …) is doubtful: …", "everything placed from it inherits its error", "check it in the picture of \"cmfsim landmarks\", and place it by hand if it is wrong"),
    "landmark-extra": FindingKind("warning or note", "landmarks have names that only one of two sets uses", "they are not used", "place them in both sets, or use the usual names"),
    "landmark-far": FindingKind("error or warning", "a landmark lies far from its surface", "{placed}; a placement error does not exceed {most:g} mm", "place it on the surface"),
    "landmark-frame": FindingKind("error", "the landmarks are in another frame or unit than the surfaces or the image", "cuts, muscles and the region are placed from landmarks", "check that landmarks and surfaces are from one patient and in one frame"),
    "landmark-missing": FindingKind("error or warning or note", "landmarks are missing that a cut, the region, the lips or the muscles need", "what is placed from them is refused, or placed less exactly", "place them"),
    "landmark-outside-image": FindingKind("error or warning", "… of … landmarks lie outside the image…: ……", "cuts, muscles and the region are placed from landmarks", "check the frame of the landmarks, and place them again"),
    "landmark-spelling": FindingKind("note", "… labels are spelled differently: ……", "they are treated as the same landmarks", "nothing needs to be done, but a single spelling is easier to find"),
    "landmark-unset": FindingKind("note", "… points were never placed and are skipped: …", "items placed from them use their defaults or are refused", "place them in 3D Slicer, or delete them"),
    "landmarks-after-unused": FindingKind("note", "the landmarks of the post-operative face are not used, because the pre-operative ones were found automatically", "Distances are those to the closest point, which ignores skin that slid along itself. An error of a proposed landmark would count as an error of the prediction.", "Place the skin landmarks before the operation as well, and name the file under [landmarks]."),
    "landmarks-automatic": FindingKind("note", "the build will find the landmarks that the case does not give; the doctor does not check …", "items placed from landmarks can be checked only when the landmarks are known; the build stops if they are insufficient", "run \"cmfsim landmarks case.toml\" to see them with their expected errors, and name its files under [landmarks]; the doctor then checks everything"),
    "landmarks-filled": FindingKind("note", "… landmarks were placed by hand, and others follow them: …", "cuts, muscles, the region and the lips are placed from all of them", "check them on the page of \"cmfsim landmarks case.toml --page\", and place those that are wrong"),
    "landmarks-no-picture": FindingKind("warning", "the picture was not drawn: …", "the landmarks should be checked before they are used", "open the files in 3D Slicer together with the head"),
    "landmarks-not-completed": FindingKind("warning", "the case names … landmarks of the skull, and no others were found automatically: …", "what the placed ones do not suffice for is left out or refused", "place more landmarks by hand"),
    "landmarks-not-found": FindingKind("warning", "the case names no landmarks, and none were found automatically: …", "the region is placed by the depth of the head, and the contact of the teeth from the image alone", "place the landmarks by hand and name the files under [landmarks]"),
    "landmarks-off": FindingKind("error or warning", "many landmarks of a set lie far from their surface", "errors of placement do not explain so many", "check that both files come from the same patient and the same scan"),
    "landmarks-proposed": FindingKind("note", "… landmarks were found automatically; none was placed by hand; expected error … mm (median), … mm (largest)", "cuts, muscles, the region and the lips are placed from them", "\"cmfsim landmarks case.toml\" writes them with a picture: check them in 3D Slicer and name the files under [landmarks]"),
    "landmarks-shifted": FindingKind("error or warning", "all … landmarks of the … lie …: moved back, they lie … mm from the … on average, now … mm", "a set that is displaced as a whole was placed in another image or frame; every cut, muscle or measured point is displaced with it", "check that the landmarks were placed in this image (same series, same frame, not resampled or aligned since), and export them again"),
    "landmarks-swapped": FindingKind("error", "… at … and … at … seem to be swapped: when exchanged, they fit all the others (… mm apart)", "each pulls nearby muscles and cuts to the wrong place", "swap the two labels, or place both again"),
    "left-right-swapped": FindingKind("error", "left and right are swapped, in landmarks or in muscles of a template", "cuts and muscles would be placed on the wrong side", "swap the labels _L and _R of these points"),
    "lip-seam-doubtful": FindingKind("warning", "the seam between the lips and the landmarks of the mouth disagree, or the skin does not show it", "the mouth may be cut in the wrong place", "check the landmarks and the seam in node_kinds.png, or give seam in [lips]"),
    "lip-seam-not-found": FindingKind("warning", "the lips were not separated: …", "the upper and lower lip stay joined, and pull on each other when the jaws move apart", "place the skin landmarks cheilion_L, cheilion_R, labiale_superius and labiale_inferius and the skull landmarks of both arches, or give a surface between the lips as seam in [lips]"),
    "lips-apart": FindingKind("note", "the lips are apart in the image as far back as the teeth, so there was no tissue to separate", "contact between them is still active", "nothing to do"),
    "lips-contact": FindingKind("error or warning", "contact of the lips and the rest of the model do not fit together", "the lips may pass through each other, or stay attached to the teeth", "set contact = false in [lips], or choose a model and a method that solve contact"),
    "mandible-left-out": FindingKind("warning", "the mandible is not separated from the skull, because the part taken for it is not one: …; the plan does not need it", "lower teeth do not close on the moved upper ones, and muscles of the lower jaw are placed without its landmarks", "place infradentale, sub_m2_L and sub_m2_R by hand and name the file under [landmarks], or give surfaces of both bones"),
    "many-border-matches": FindingKind("note", "… of … vertices are matched to the border of the post-operative skin and excluded", "the scan ends there, or the landmarks map the skin past its end", "evaluate only the face with mask='face', or use a mask of the simulated skin"),
    "mesh-poor-tet": FindingKind("warning", "tet … has a dihedral angle of …°", "its deformation is inaccurate, and it worsens the conditioning of the system", "change edge_length slightly, or set refinements = 0"),
    "metal": FindingKind("warning", "… pieces of metal, … cm³ above … HU, between z = … and … mm; …", "streaks obscure skin and bone at that height", "check lips, cheeks and tooth rows visually"),
    "moduli-unusual": FindingKind("error or warning", "no soft tissue has these moduli, or fat with them cannot lie between muscles", "published Young's moduli lie within {low:g} to {high:g} MPa, Poisson's ratios within {least:g} to 0.5", "check digits and unit: moduli are in MPa, so 10 kPa is 0.01; Poisson's ratio of fat is about 0.46, not 0.046"),
    "motion-bent": FindingKind("warning", "… has a different shape after the operation: …", "bone does not bend during an operation; each vertex is followed along the normal of the bone, and along the bone as far as bending explains it", "if a piece was cut, make it a separate segment in [[osteotomies]]; otherwise check both segmentations and the picture of the plan"),
    "motion-open": FindingKind("warning", "the shape of … hardly determines …: eigenvalue ratio …, … is needed", "its motion in that direction is {left}", "give a larger or less symmetric part of the bone that includes teeth, or give the motion as numbers in [plan]"),
    "motion-pieces": FindingKind("note", "a bone moved as several rigid pieces", "bone was cut between them: each piece is followed", "nothing to do; check the picture of the plan"),
    "motion-slip": FindingKind("note", "vertices slid along the bone or moved with noise, which is taken out", "bone does not bend from one vertex to the next, and the noise would crumple the tissue on it", "nothing to do"),
    "moved-all": FindingKind("warning", "every bone moves: …, by … mm at least", "jaw surgery does not move the skull above the jaws; if the scans are in different frames, the whole face would move by the difference", "register the post-operative scan to the pre-operative one on the skull (register_volumes, icp)"),
    "moved-not-paired": FindingKind("error", "a bone before and after cannot be paired: mirrored, in another order, or with other vertices", "the motion of each vertex is unknown", "export the bone before, and the same mesh after the motion"),
    "moved-remeshed": FindingKind("note", "… has … triangles after and … before, or numbers them differently, so its rigid motion is found by its shape", "vertices cannot be followed; a bone that was cut into pieces gets the motion of its largest piece", "nothing to do if the bone is one piece that was segmented or remeshed twice; otherwise name each piece"),
    "moved-scaled": FindingKind("error or warning or note", "… is … times as large after the operation as before (95 % interval … to …, by its shape)", "bone does not grow during an operation, so the scans are calibrated or segmented differently", "check the voxel sizes of both scans and the thresholds of both segmentations, and measure again"),
    "muscle-does-not-fit": FindingKind("note", "a muscle lies partly outside the tissue", "the tissue is thinner there than the muscle; that part has no tets", "check this muscle; landmarks near it may be misplaced"),
    "muscle-missed": FindingKind("warning", "… contains no sample of any tet", "It does not affect the tissue: it lies outside the mesh, or encloses nothing.", "Check its frame and that its surface is closed, or use more samples."),
    "muscle-moduli": FindingKind("note", "moduli differ from those of …, MPa: …", "Displacements depend on the ratios of moduli; the accuracy was measured with those of the preset.", "nothing to do"),
    "muscle-sheet": FindingKind("note", "… is a sheet: second extent … of the first", "The direction of its fibres can hardly be determined from its outline.", "Add fibre lines (course) for this muscle."),
    "muscles-left-out": FindingKind("warning", "… muscles are left out: …: …", "their place in this head is unknown; the tissue there is that of fat", "place menton, gonion_L and gonion_R for muscles of the lower jaw, nasion, zygomatic_arch_L and zygomatic_arch_R for those of the cranium"),
    "muscles-none": FindingKind("warning", "no muscle was given, so every tet is fat", "The tissue is homogeneous and isotropic.", "give muscles, or use a model without them"),
    "not-operated-none": FindingKind("note", "the error where nothing was operated on is not known: …", "Errors of registration, swelling and weight cannot be separated from the error of a model.", "Use scans that both show the forehead and temples."),
    "not-segmented": FindingKind("note", "the doctor has not segmented the image: it has not looked at skin, bones, jaws and automatic landmarks", "what is doubtful or impossible in them is found only when the image is segmented", "run \"cmfsim landmarks case.toml\" or \"cmfsim build case.toml\", which segment it and report what they find"),
    "osteotomy-parts": FindingKind("warning or note", "a cut leaves disconnected parts or fragments", "disconnected parts move together as one segment", "check the picture of the segments; move the planes"),
    "output-not-writable": FindingKind("error", "the output folder cannot be written to", "the results could not be written at the end of the run", "choose another folder, or change its permissions"),
    "page-simplified": FindingKind("note", "… has … triangles; the page draws it with …, at most … mm away", "a page with all triangles is slow to open and to send", "nothing to do: predictions use all triangles"),
    "plan-bite-poor": FindingKind("warning", "as planned, overjet, open bite, midlines or cant are beyond published limits, and further than before", "operations on the jaws make bites better; teeth that do not meet afterwards cannot hold the jaws", "check the motion of each jaw, its sign and its size, and whether one is missing; cmfsim bite makes the lower jaw follow into a bite that scans show; nothing to do if this bite is meant"),
    "plan-centre-far": FindingKind("warning", "… turns about a point … mm away from it, and moves by up to … mm", "a segment is turned about one of its own landmarks; about a point of another patient, the same angle moves it elsewhere", "give centre in the coordinates of this patient, such as the place of the upper incisors; was the plan copied from another case?"),
    "plan-far": FindingKind("error or warning", "… moves by up to … mm, at …", "ordinary surgery moves bone by at most {most:g} mm; tissue would tear", "check translation (mm), sign, frame and centre of the motion"),
    "plan-frame": FindingKind("warning", "the motion of … has no frame and is read as LPS, but the surfaces are in …", "the other frame reverses forwards and backwards, left and right", "write frame = \"LPS\" or frame = \"{frame}\" next to the numbers of the motion"),
    "plan-head-turned": FindingKind("warning", "the head is turned by …° against the axes of its files, along which … moves … mm: …", "forwards and up of the head are not those of the files: of 4 mm forwards, 1 mm goes up or down where the head nods by 15°", "if forwards and up are meant as the head has them: translation = …; nothing to do if the plan was made with the head as it lies"),
    "plan-no-centre": FindingKind("warning", "… turns by …° about the origin of the coordinates, for no centre is given: the turn moves it by up to … mm", "a segment is turned about one of its own landmarks; about another point, the same angle moves it elsewhere", "give centre, such as the place of the upper incisors; centre = [0, 0, 0] if the origin is meant"),
    "plan-other-case": FindingKind("warning", "the plan was made for another case, or for other images, landmarks or cuts of this case", "its numbers are places in the head that it was made for: in another, the same numbers move bone elsewhere", "check the motions in words, or create the planning page again and save the plan from it"),
    "plan-sideways": FindingKind("warning", "… moves … mm to the …, which is most of its motion", "jaws are moved forwards, back, up or down, and to a side by a few millimetres", "check the order of the numbers: to the left, backwards, up (LPS), so 5 mm forwards is [0, -5, 0]; nothing to do if it is meant"),
    "plan-still": FindingKind("warning", "no segment moves, or one that the plan names", "the predicted face is the face before the operation", "give a motion in [plan.SEGMENT], or a file of the planning page by --plan"),
    "plan-through-bone": FindingKind("warning", "… lies … mm deeper within … than before, at …", "bone does not pass through bone, nor teeth through teeth: the plan cannot be carried out, and the face over it would be wrong", "check signs, units and whether the tables of the jaws are exchanged; a jaw that is not moved may lack its motion"),
    "plan-through-skin": FindingKind("warning", "… is moved through the undeformed skin, by … mm at …", "the tissue over it would be crushed or inverted", "check the plan; if the advancement is really that large, solve it in steps"),
    "plan-tiny": FindingKind("warning", "a segment moves by less than operations do", "bones are moved by millimetres, and an operation is not more exact than 1 mm", "check the unit: translations and matrices are in mm ({size:.2g} {unit} would be {larger:.2g} mm); if the segment does not move, remove it from the plan"),
    "plan-tiny-angle": FindingKind("warning", "… turns by …°", "operations are not planned that precisely; {angle:.2g} radians would be {degrees:.1f}°", "check the unit: angles are in degrees; nothing to do if the rotation is intended, or was measured"),
    "plan-turned": FindingKind("error or warning", "… turns by …°", "ordinary surgery rotates bone by at most {most:g}°; linear strain creates spurious volume", "check angle (degrees, not radians) and axis"),
    "photo-placed": FindingKind("warning or note", "the 3D photo lies … mm from the skin (median); … of the skin has its colours, the rest is grey", "colours are for the eye: no figure depends on them, and skin that the photo does not show is grey", "look at the colours of lips and eyes in the report; give more landmarks if they are off, and check that the photo is this patient's from before the operation"),
    "postoperative-other-face": FindingKind("error or warning", "the faces before and after the operation differ …", "another patient's face, or a scan in another frame or unit, gives errors that no model makes: every figure of the evaluation includes this difference", "check that the post-operative file is this patient's and is registered on the skull above the jaws (aligned = false registers it), with the right frame and units; if it is right, write verified = true in [postoperative]"),
    "postoperative-unchanged": FindingKind("error or warning", "the face after the operation is the face before: where the plan moves the skin most, they differ by … mm on average", "the prediction would be compared with a face that was not operated on", "give the scan after the operation; if it is right, write verified = true in [postoperative]"),
    "regions-none": FindingKind("note", "regions of the face are placed by proposed landmarks, or not at all", "the case has no complete skin landmarks", "place the skin landmarks, or check the proposed ones with cmfsim landmarks and save them"),
    "rest-removed": FindingKind("note", "… cm³ of couch, pillow or head-rest was removed", "where it touched the head, the skin comes from the shape of the head, not from the image", "check the back of the head visually if it matters"),
    "segment-near-end": FindingKind("warning", "… moves, and the tissue ends, fixed, … mm below … (z = … mm, end at … mm; at least … mm is needed)", "tissue below the chin cannot follow: the face there moves too little, or not at all", "…, or exclude that part of the face from the evaluation"),
    "segment-no-tissue": FindingKind("error or warning", "a segment that moves touches no tissue", "its motion does not reach the face", "check region (posterior plane, lower, upper), and that the skin encloses it"),
    "septum-left-out": FindingKind("note", "the nasal septum is not modelled: … is followed vertex by vertex", "without its support, the tip of the nose follows the maxilla too far, mostly upwards", "add these landmarks, or set septum = false in [node_kinds]"),
    "sites-on-other-jaw": FindingKind("error", "no bone lies more than … mm below the landmarks supradentale and supra_m2, although the image goes on for … mm below the upper teeth", "these landmarks of the upper jaw seem to lie on the lower one: the plan would move that", "place supradentale, supra_m2_L and supra_m2_R on the upper jaw"),
    "skin-attachment": FindingKind("warning", "something protrudes from the face, …: … mm…", "a tube, a holder, a pad or tape on the face is treated as skin: it is moved and compared as skin", "check it in the image; erase it there (air, −1000 HU), or exclude that part of the face from the evaluation"),
    "skin-implausible": FindingKind("warning", "tissue in front of bone is missing at …; the skin has no nose: …", "the level between air and tissue may have lost skin, or the image ends there: the face is wrong there before it is moved", "check the skin in the picture; try skin_threshold = -500 in [image], or use another reconstruction of the scan"),
    "skin-torn": FindingKind("warning", "edges of the predicted skin are stretched by more than half, or triangles are turned over", "no skin stretches or folds like this: the face there is wrong, usually because bone moves far next to fixed tissue, or because jaws pull lips apart that are one piece", "look at the face there and check the plan; next to the end of the tissue, move its plane away ([region]); between the lips, set contact = true in [lips]"),
    "skin-weak": FindingKind("warning", "tissue at the front of the face is up to … HU too dark for a fixed level of the skin, which was lowered there", "nose and lips would lose their surface; it is less accurate there than elsewhere", "check nose and lips visually; use a reconstruction with a larger field of view"),
    "sliding-landmarks": FindingKind("warning or note", "landmarks of the teeth are missing, from which sliding regions are placed", "lips and cheeks would be attached to the teeth", "place the landmarks if lips or cheeks are important"),
    "surface-crossing": FindingKind("warning or note", "triangles intersect, or are too crowded to check for it", "volume enclosed twice counts once, and volume between the folds may count as outside", "smooth or remesh it there"),
    "surface-degenerate": FindingKind("warning or note", "triangles are slivers, without area, or repeated", "their normals are unreliable, which disturbs contact", "remesh the surface"),
    "surface-frame": FindingKind("error", "skin and bones are in different frames, or the mandible does not lie below and before the cranium", "skin and bones of a case must be in one frame", "export skin and bones in the same frame"),
    "surface-inner-wall": FindingKind("error or warning", "the skin has an inner wall, which encloses … of the outer one's volume; the outer wall was used", "a skin saved as a shell (Hollow tool, threshold of the skin alone) has two walls, and bone inside the inner one would lie outside the skin", "look at the skin; export it as a solid if the wrong wall was kept"),
    "surface-islands": FindingKind("warning or note", "… pieces besides the largest, with … of its area; the next has … triangles at …", "debris becomes islands of bone or skin; pieces below 1 % of the largest are dropped", "delete the pieces that do not belong to it, or put each bone into a separate file"),
    "surface-non-manifold": FindingKind("warning", "edges have more than two triangles", "the surface forks there, so inside and outside are undefined near it", "remove inner walls and repeated parts, or remesh it (cmfsim.repair_surface)"),
    "surface-normals": FindingKind("error or warning", "normals of a surface point inwards, or differ from place to place", "inside and outside are swapped, or differ from place to place", "flip or recompute normals in the program that wrote it (cmfsim.repair_surface)"),
    "surface-open": FindingKind("warning or note", "a surface has open borders", "only a closed surface has an inside and an outside: gaps are capped", "check the caps after build; if they are wrong, close the surface yourself"),
    "surface-repaired": FindingKind("note", "a surface was repaired: vertices merged, triangles removed or turned outwards, small pieces dropped", "faults like these conceal edges, swap inside and outside, or become islands of bone or skin", "look at the result; nothing to do"),
    "surface-units": FindingKind("error or warning", "a surface has the size of another unit, or of no head", "every length of the case is mm; a head is 110 to 420 mm long", "write units = \"mm\" under [surfaces], or leave units out"),
    "teeth-of-scan": FindingKind("note", "the upper crowns are those of the scan, which fits to … mm", "the contact of lips and cheeks with the teeth is that of the scan, not of what metal leaves of the image", "nothing to do"),
    "template-landmarks": FindingKind("error", "the landmarks of a template do not determine a map to the patient", "the template cannot be fitted to the patient by these landmarks", "place more landmarks"),
    "template-landmarks-few": FindingKind("note", "the landmarks of a template cannot be checked against one another", "a misplaced landmark would go unnoticed", "place more"),
    "template-landmarks-missing": FindingKind("warning", "landmarks of the template are missing", "near them, muscles follow landmarks that are further away", "place them, or use a homogeneous model"),
    "template-off": FindingKind("warning", "a muscle, fibre line or landmark of a template lies far from where it belongs", "it has another frame or unit than the skull, or belongs to something else", "convert all parts to one frame and unit"),
    "template-sides": FindingKind("error or warning", "the two sides of a muscle do not match", "a muscle on one side only pulls the face to that side", "add it, mirrored if necessary"),
    "template-source": FindingKind("warning", "a template does not state its source or attribution", "most licences require attribution; without a source, its origin is unknown", "write source = \"…\" and attribution = \"…\" in template.toml"),
    "template-unusable": FindingKind("error", "a part of a template is missing, wrong or contradictory", "the template cannot be used", "correct the entry"),
    "tissue-ends-loose": FindingKind("warning", "the tissue ends on the … border of the image over … mm², and nothing is fixed there", "the missing tissue would hold the face back, so the face moves too far near that border", "use an image that shows the whole face…"),
    "tissue-not-held": FindingKind("error or warning or note", "tissue is not held by bone, or specks of it were removed", "nothing determines their motion", "nothing to do; check the thresholds if a part of the face is missing"),
    "unknown-name": FindingKind("error", "a segment, bone, muscle or preset is named that does not exist", "it would have no effect", "use one of: {names}"),
})
# Codes of results and scripts that were written before codes of one kind became one.
FORMER_CODES: Mapping[str, str] = MappingProxyType({
    former: code
    for code, formers in {
        "bodyparts3d-parts": "bodyparts3d-broken bodyparts3d-mirrored bodyparts3d-names bodyparts3d-other-file",
        "bone-outside-skin": "bone-through-skin",
        "contact-sheet": "contact-sheet-both-arches contact-sheet-far contact-sheet-sharp",
        "contact-stopped": "touching-stopped",
        "correspondence-folds": "template-folds",
        "ct-cut-off": "ct-cut-bottom ct-cut-front ct-cut-left ct-cut-right ct-cut-round ct-cut-top "
        "ct-cut-vertex",
        "ct-flipped": "ct-facing-back ct-upside-down",
        "ct-not-hu": "dicom-not-hu",
        "dicom-skipped": "dicom-copies dicom-other-files dicom-scouts",
        "dicom-tilted": "dicom-tilt-unclear",
        "file-missing": "template-file-missing",
        "frame-turned": "frame-tilted",
        "frame-unstated": "image-frame-unstated landmark-frame-unstated",
        "image-oblique": "image-sheared",
        "input-unreadable": "image-unreadable landmarks-unreadable postoperative-unreadable surface-unreadable "
        "template-unreadable transform-unreadable",
        "jaw-doubtful": "jaw-impossible",
        "jaws-separated-again": "jaws-not-separated-again",
        "landmark-disagrees": "template-landmarks-disagree",
        "landmark-extra": "template-landmarks-extra",
        "landmark-frame": "landmark-units",
        "landmark-missing": "landmarks-missing lips-landmarks-few lips-landmarks-missing muscles-without-landmarks "
        "region-unplaced",
        "landmarks-off": "postoperative-landmarks-off",
        "left-right-swapped": "landmark-pair-swapped template-landmarks-swapped template-muscles-swapped",
        "lip-seam-doubtful": "lip-landmark-far lip-seam-from-landmarks lip-seam-outside",
        "lips-contact": "lips-attached lips-method lips-without-contact",
        "moduli-unusual": "fat-moduli",
        "motion-pieces": "motion-torn",
        "motion-slip": "motion-noisy",
        "moved-not-paired": "moved-mirrored moved-scrambled",
        "muscle-does-not-fit": "muscle-cut-off",
        "osteotomy-parts": "osteotomy-crumbs",
        "plan-still": "moved-still",
        "plan-tiny": "plan-small",
        "regions-none": "regions-proposed",
        "segment-no-tissue": "segment-touches-no-tissue segment-without-nodes",
        "sliding-landmarks": "sliding-from-teeth",
        "surface-crossing": "surface-crossings-unknown template-crosses-itself",
        "surface-degenerate": "surface-slivers",
        "surface-frame": "bone-elsewhere",
        "surface-non-manifold": "template-not-manifold",
        "surface-normals": "surface-inconsistent surface-inward template-inside-out",
        "surface-open": "muscle-open surface-closed template-open",
        "surface-repaired": "muscle-inside-out surface-cleaned surface-debris surface-turned surface-welded",
        "surface-units": "surface-size template-skull-size",
        "template-landmarks": "muscles-landmarks template-landmarks-coincide template-landmarks-flat",
        "template-off": "template-course-outside template-far-from-skull template-landmark-off-skull",
        "template-sides": "template-partner-kind template-partner-missing template-side-name",
        "template-source": "template-attribution",
        "template-unusable": "template-archive template-content template-format template-licence template-muscle "
        "template-surface template-text",
        "tissue-not-held": "mesh-specks-dropped",
        "unknown-name": "cut-unknown-bone muscle-moduli-unknown plan-unknown-segment tissue-preset",
    }.items()
    for former in formers.split()
})
# fmt: on
