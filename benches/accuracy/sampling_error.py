"""Errors of muscle fractions against samples and run time; errors on defective surfaces.

    python -m benches.accuracy.sampling_error --out folder

writes sampling_error.png, sampling_error.csv and inside_tests.csv. Three methods are compared on
tets cut by a finely triangulated plane, where the fraction is known exactly: `equivalent_material`;
random points with one winding number each; random points with the paper's test (closest normal
against closest-distance vector, Kim et al. 2010, section 2.3).
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np

import cmfsim
from benches.scenes import meshes

SEED = 20100
SAMPLES = (4, 16, 64, 256, 1024)
# Cubes along the box of tets, of 1 mm; squares along each face of the muscle.
CUBES, SQUARES = 10, 64
Floats = np.ndarray


def cuboid(half: float, squares: int) -> tuple[Floats, Floats]:
    """A closed cube of 12 squares² triangles, from −half to half."""
    line = np.linspace(-half, half, squares + 1)
    u, v = np.meshgrid(line, line, indexing="ij")
    i, j = (a.ravel() for a in np.meshgrid(*[np.arange(squares)] * 2, indexing="ij"))
    corner = [(i + a) * (squares + 1) + j + b for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    face = np.concatenate([np.stack(corner[:3], 1), np.stack([corner[0], *corner[2:]], 1)])
    vertices: list[Floats] = []
    triangles: list[Floats] = []
    for axis in range(3):
        for side in (-half, half):
            points = np.roll(np.stack([np.full(u.size, side), u.ravel(), v.ravel()], 1), axis, 1)
            triangles.append(len(vertices) * u.size + (face if side > 0 else face[:, ::-1]))
            vertices.append(points)
    points, inverse = np.unique(np.concatenate(vertices).round(12), axis=0, return_inverse=True)
    return points, inverse.ravel()[np.concatenate(triangles)]


def positive_part(values: Floats) -> Floats:
    """Part of each tet where a linear function with these corner values ((m, 4)) is positive.

    Σ over corners with f_i > 0 of f_i³ / Π_{j≠i} (f_i − f_j).
    """
    part = np.zeros(len(values))
    for i in range(4):
        others = [j for j in range(4) if j != i]
        term = values[:, i] ** 3 / np.prod(values[:, i, None] - values[:, others], axis=1)
        part += np.where(values[:, i] > 0.0, term, 0.0)
    return part


def random_points(nodes: Floats, tets: Floats, samples: int, rng: np.random.Generator) -> Floats:
    """Points uniform in each tet, (m, samples, 3)."""
    weights = rng.dirichlet(np.ones(4), (len(tets), samples))
    points: Floats = np.einsum("mak,mac->mck", nodes[tets], weights.transpose(0, 2, 1))
    return points


def by_winding(surface: cmfsim.Surface, points: Floats) -> Floats:
    """Whether each point has a winding number above one half."""
    return surface.winding_number(points) > 0.5


def by_normal(surface: cmfsim.Surface, points: Floats) -> Floats:
    """The paper's test: the closest normal points away from the point."""
    closest, normals, _ = surface.closest(points)
    inside: Floats = np.einsum("na,na->n", closest - points, normals) > 0.0
    return inside


def measure(repeat: int) -> list[dict[str, float | str]]:
    """Root-mean-square error of the fraction of cut tets, and time per cut tet, of each way."""
    rng = np.random.default_rng(SEED)
    nodes, tets = meshes.box((CUBES,) * 3, (float(CUBES),) * 3, jitter=0.2, seed=1)
    mesh = cmfsim.TetMesh(nodes, tets)
    vertices, triangles = cuboid(30.0, SQUARES)
    rows: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for _ in range(repeat):
        frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        frame *= np.sign(np.linalg.det(frame))
        through = 0.5 * CUBES + rng.uniform(-1.0, 1.0, 3)
        # The face at 30 mm along the first axis of the frame passes through the mesh.
        placed = (vertices - [30.0, 0.0, 0.0]) @ frame.T + through
        exact = positive_part(-((nodes - through) @ frame[:, 0])[tets])
        cut = (exact > 1e-9) & (exact < 1.0 - 1e-9)
        muscle = cmfsim.Surface(placed, triangles)
        muscle.winding_number(placed[:1])
        for samples in SAMPLES:
            mixture = cmfsim.equivalent_material(mesh, [muscle], samples=samples)
            spent = mixture.timings["crossing"] + mixture.timings["sampling"]
            error = np.sqrt(np.mean((mixture.fraction - exact)[cut] ** 2))
            rows.setdefault(("cmfsim", samples), []).append((error, spent / cut.sum()))
            for name, test in (("random, winding", by_winding), ("random, paper", by_normal)):
                start = time.perf_counter()
                points = random_points(nodes, tets[cut], samples, rng)
                inside = test(muscle, points.reshape(-1, 3)).reshape(points.shape[:2])
                spent = time.perf_counter() - start
                error = np.sqrt(np.mean((inside.mean(1) - exact[cut]) ** 2))
                rows.setdefault((name, samples), []).append((error, spent / cut.sum()))
    return [
        {
            "way": way,
            "samples": samples,
            "rms_error": float(np.sqrt(np.mean([e * e for e, _ in runs]))),
            "us_per_tet": 1e6 * float(np.median([t for _, t in runs])),
        }
        for (way, samples), runs in rows.items()
    ]


def bad_surfaces() -> list[dict[str, float | str]]:
    """Volume that each inside test loses of two spheres in one surface, whole or damaged."""
    nodes, tets = meshes.box((14, 10, 10), (14.0, 10.0, 10.0), jitter=0.2, seed=2)
    mesh = cmfsim.TetMesh(nodes, tets)
    cube, triangles = cuboid(1.0, 24)
    ball = cube / np.linalg.norm(cube, axis=1)[:, None]
    radius, apart = 3.0, 2.5
    centres = [[7.0 - 0.5 * apart, 5.0, 5.0], [7.0 + 0.5 * apart, 5.0, 5.0]]
    vertices = np.concatenate([radius * ball + c for c in centres])
    both = np.concatenate([triangles, triangles + len(ball)])
    cap = radius - 0.5 * apart
    exact = 2.0 * (4.0 / 3.0 * np.pi * radius**3 - np.pi * cap**2 * (3.0 * radius - cap) / 3.0)
    rng = np.random.default_rng(SEED)
    holed = np.delete(both, rng.choice(len(both), len(both) // 50, replace=False), axis=0)
    flipped = both.copy()
    turned = rng.choice(len(both), len(both) // 50, replace=False)
    flipped[turned] = flipped[turned, ::-1]
    apart_only = both[: len(triangles)]
    rows: list[dict[str, float | str]] = []
    cases = (
        ("one sphere", apart_only, 4.0 / 3.0 * np.pi * radius**3),
        ("overlap", both, exact),
        ("overlap, 2 % of triangles missing", holed, exact),
        ("overlap, 2 % of triangles flipped", flipped, exact),
    )
    for name, faces, volume in cases:
        surface = cmfsim.Surface(vertices, faces)
        row: dict[str, float | str] = {"surface": name}
        for inside in ("winding", "normal"):
            made = cmfsim.equivalent_material(mesh, [surface], inside=inside)
            row[f"{inside}_lost_percent"] = 100.0 * (1.0 - made.volumes["muscle_0"].inside / volume)
            row[f"{inside}_s"] = made.timings["crossing"] + made.timings["sampling"]
        rows.append(row)
    return rows


def write(path: Path, rows: list[dict[str, float | str]]) -> None:
    """The rows as CSV, and on the terminal."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    for row in rows:
        print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else str(v) for k, v in row.items()))


def draw(path: Path, rows: list[dict[str, float | str]]) -> None:
    """Error against samples, and against time."""
    import matplotlib as mpl  # noqa: PLC0415 (only the picture needs it)

    mpl.use("Agg")
    import matplotlib.pyplot as plt  # noqa: PLC0415

    figure, axes = plt.subplots(1, 2, figsize=(10.0, 4.2), sharey=True, layout="constrained")
    marks = {"cmfsim": "o-", "random, winding": "s--", "random, paper": "^:"}
    for way, mark in marks.items():
        chosen = [row for row in rows if row["way"] == way]
        error = [100.0 * float(row["rms_error"]) for row in chosen]
        for axis, key in zip(axes, ("samples", "us_per_tet"), strict=True):
            axis.loglog([float(row[key]) for row in chosen], error, mark, label=way)
    samples = np.array(SAMPLES, dtype=float)
    first = 100.0 * next(float(r["rms_error"]) for r in rows if r["way"] == "cmfsim")
    slope = first * (samples / samples[0]) ** (-2.0 / 3.0)
    axes[0].loglog(samples, slope, color="0.7", lw=1, zorder=0, label="slope −2/3")
    axes[0].set(xlabel="samples per cut tet", ylabel="RMS error of the fraction (%)")
    axes[1].set(xlabel="time per cut tet (µs)")
    for axis in axes:
        axis.grid(which="both", alpha=0.25)
    axes[0].legend()
    figure.suptitle(f"Tets cut by a plane of {12 * SQUARES**2} triangles")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measures, writes the tables and draws the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path())
    parser.add_argument("--repeat", type=int, default=5, help="planes")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = measure(arguments.repeat)
    write(arguments.out / "sampling_error.csv", rows)
    write(arguments.out / "inside_tests.csv", bad_surfaces())
    draw(arguments.out / "sampling_error.png", rows)


if __name__ == "__main__":
    main()
