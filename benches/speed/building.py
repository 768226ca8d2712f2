"""Time and memory of `cmfsim build` for the size of a clinical CT, by stage: building.py [CASE].

Without a case, the phantom's CT is resampled to 512 × 512 × 200 voxels of 0.45 × 0.45 × 1 mm with
noise of 25 HU. Prints a table in Markdown.
"""

import platform
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import cmfsim

SHAPE = (512, 512, 200)
SPACING = (0.45, 0.45, 1.0)  # mm
NOISE = 25.0  # HU


def main(case_file: Path | None) -> None:
    """Builds the case, or a made one, and prints its stages."""
    with tempfile.TemporaryDirectory() as folder:
        path = case_file or _clinical_case(Path(folder))
        case = cmfsim.Case.load(path)
        started = time.perf_counter()
        model = cmfsim.build_case(case)
        seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print("| stage | s |\n| --- | ---: |")
    for stage, took in model.summary["timings"].items():
        print(f"| {stage} | {took:.2f} |")
    print(f"| all, with writing and drawing | {seconds:.1f} |")
    mesh = model.summary["mesh"]
    print(
        f"\n{mesh['n_tets']} tets, least dihedral angle {mesh['min_dihedral']:.1f}°, "
        f"peak memory {peak:.0f} MB; {platform.processor() or platform.machine()}, "
        f"cmfsim {cmfsim.__version__}"
    )


def _clinical_case(folder: Path) -> Path:
    """The phantom with the voxels of a clinical scan, cut to what such a scan shows."""
    import SimpleITK  # noqa: PLC0415

    head = cmfsim.make_head()
    path = cmfsim.write_phantom_case(folder, head, spacing=1.0)
    image = SimpleITK.ReadImage(str(folder / "ct.nrrd"))
    size, step = np.array(image.GetSize()), np.array(image.GetSpacing())
    middle = np.array(image.GetOrigin()) + 0.5 * (size - 1) * step
    middle[2] -= 25.0
    origin = middle - 0.5 * (np.array(SHAPE) - 1) * np.array(SPACING)
    fine = SimpleITK.Resample(
        image,
        SHAPE,
        SimpleITK.Transform(),
        SimpleITK.sitkLinear,
        origin.tolist(),
        SPACING,
        (1, 0, 0, 0, 1, 0, 0, 0, 1),
        -1000.0,
        SimpleITK.sitkFloat32,
    )
    values = SimpleITK.GetArrayFromImage(fine).T
    noise = np.random.default_rng(0).normal(0.0, NOISE, values.shape).astype(np.float32)
    noisy = np.rint(values + noise).astype(np.int16)
    cmfsim.write_image(cmfsim.ImageData(noisy, SPACING, origin), folder / "ct.nrrd")
    return path


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
