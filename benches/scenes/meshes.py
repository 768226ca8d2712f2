"""Procedural meshes, materials and integrals of tests and benches, all seeded: no data files."""

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]

# The two index pairs of each Voigt component: xx, yy, zz, yz, xz, xy.
VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def oriented(nodes: Floats, tets: NDArray[np.integer]) -> Indices:
    """The tets with two nodes swapped where their volume is negative."""
    turned = tets.astype(np.uint32)
    negative = volumes(nodes, turned) < 0.0
    turned[negative] = turned[negative][:, [0, 2, 1, 3]]
    return turned


def volumes(nodes: Floats, tets: NDArray[np.integer]) -> Floats:
    """Signed volumes: det(b − a, c − a, d − a) / 6."""
    a, b, c, d = (nodes[tets[:, i]] for i in range(4))
    found: Floats = np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6.0
    return found


def box(
    cells: tuple[int, int, int] = (2, 2, 2),
    size: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    jitter: float = 0.0,
    keep_layers: bool = False,
    seed: int = 0,
) -> tuple[Floats, Indices]:
    """A box from the origin, each cell cut into Kuhn's six tets round its main diagonal.

    `jitter`: random shift of inner nodes, in cells, with `keep_layers` never along x; below 0.25 no
    tet turns over.
    """
    _, ny, nz = cells
    axes = [np.arange(n + 1, dtype=np.float64) for n in cells]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inner = np.all((grid > 0) & (grid < np.array(cells)), axis=1)
    shift = np.random.default_rng(seed).uniform(-jitter, jitter, grid.shape)
    if keep_layers:
        shift[:, 0] = 0.0
    nodes = (grid + np.where(inner[:, None], shift, 0.0)) * (np.array(size) / np.array(cells))
    i, j, k = (a.ravel() for a in np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"))
    step = np.array([(ny + 1) * (nz + 1), nz + 1, 1])
    corner = i * step[0] + j * step[1] + k * step[2]
    tets = []
    for order in itertools.permutations(range(3)):
        path = np.cumsum([0, *(step[axis] for axis in order)])
        tets.append(corner[:, None] + path[None, :])
    return nodes, oriented(nodes, np.concatenate(tets))


def random_body(n_points: int = 40, *, seed: int = 0) -> tuple[Floats, Indices]:
    """The Delaunay tets of random points in a 10 mm cube, without the flattest."""
    rng = np.random.default_rng(seed)
    corners = np.array(list(itertools.product((0.0, 10.0), repeat=3)))
    points = np.concatenate([corners, rng.uniform(0.0, 10.0, (n_points, 3))])
    tets = Delaunay(points).simplices
    longest = np.max(
        [
            np.linalg.norm(points[tets[:, a]] - points[tets[:, b]], axis=1)
            for a, b in itertools.combinations(range(4), 2)
        ],
        axis=0,
    )
    tets = tets[np.abs(volumes(points, tets)) > 1e-4 * longest**3]
    used, renumbered = np.unique(tets, return_inverse=True)
    nodes = points[used]
    return nodes, oriented(nodes, renumbered.reshape(-1, 4))


def icosphere(level: int, radius: float = 1.0) -> tuple[Floats, Indices]:
    """A sphere of 20·4^level triangles, outward, by halving the edges of an icosahedron."""
    g = (1.0 + 5.0**0.5) / 2.0
    corners = [(0.0, s, t * g) for s in (-1, 1) for t in (-1, 1)]
    vertices = np.array([np.roll(c, r) for c in corners for r in range(3)])
    distance = np.linalg.norm(vertices[:, None] - vertices[None], axis=2)
    near = np.isclose(distance, 2.0)
    triangles = np.array(
        [t for t in itertools.combinations(range(12), 3) if near[np.ix_(t, t)].sum() == 6]
    )
    for _ in range(level):
        a, b, c = triangles.T
        edges = np.sort(np.concatenate([[a, b], [b, c], [c, a]], axis=1).T, axis=1)
        unique, back = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = back.reshape(3, -1) + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].sum(axis=1)])
        triangles = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    p, q, r = (vertices[triangles[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", p, np.cross(q - p, r - p)) < 0.0
    triangles[inward] = triangles[inward][:, [0, 2, 1]]
    return radius * vertices, triangles.astype(np.uint32)


def spherical_shell(
    level: int, layers: int, inner: float, outer: float
) -> tuple[Floats, Indices, Indices, Indices]:
    """Nodes and tets between two spheres, with the nodes of the inner and of the outer one.

    Each triangle of an icosphere makes a column of prisms; a prism a < b < c is cut into the tets
    abcc', abb'c', aa'b'c', so that neighbours agree on the diagonals of their common sides.
    """
    sphere, triangles = icosphere(level)
    n = len(sphere)
    radii = np.linspace(inner, outer, layers + 1)
    nodes = (radii[:, None, None] * sphere[None]).reshape(-1, 3)
    a, b, c = np.sort(triangles.astype(np.int64), axis=1).T
    tets = []
    for layer in range(layers):
        low, high = layer * n, (layer + 1) * n
        tets += [
            np.stack([a + low, b + low, c + low, c + high], axis=1),
            np.stack([a + low, b + low, b + high, c + high], axis=1),
            np.stack([a + low, a + high, b + high, c + high], axis=1),
        ]
    ids = np.arange(n, dtype=np.uint32)
    return nodes, oriented(nodes, np.concatenate(tets)), ids, ids + np.uint32(layers * n)


def plane(half_width: float, cells: int = 1, *, seed: int | None = None) -> tuple[Floats, Indices]:
    """A square in z = 0 with upward normals; with a seed its inner vertices are shuffled about."""
    axis = np.linspace(-half_width, half_width, cells + 1)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    if seed is not None:
        inner = np.all(np.abs(grid) < half_width * (1.0 - 1e-9), axis=1)
        shift = np.random.default_rng(seed).uniform(-0.4, 0.4, grid.shape)
        grid = grid + inner[:, None] * shift * (2.0 * half_width / cells)
    triangles = Delaunay(grid).simplices
    p, q, r = (grid[triangles[:, i]] for i in range(3))
    area = (q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0]
    triangles = triangles[np.abs(area) > 1e-12 * half_width**2]
    area = area[np.abs(area) > 1e-12 * half_width**2]
    triangles[area < 0.0] = triangles[area < 0.0][:, [0, 2, 1]]
    return np.column_stack([grid, np.zeros(len(grid))]), triangles.astype(np.uint32)


def nodes_where(mask: NDArray[np.bool_]) -> Indices:
    """The indices at which a mask holds."""
    return np.flatnonzero(mask).astype(np.uint32)


def outer_nodes(tets: Indices) -> Indices:
    """Nodes of the faces that belong to one tet only."""
    faces = np.sort(np.concatenate([np.delete(tets, i, axis=1) for i in range(4)]), axis=1)
    unique, counts = np.unique(faces, axis=0, return_counts=True)
    return np.unique(unique[counts == 1]).astype(np.uint32)


def rotation(axis: tuple[float, float, float], degrees: float) -> Floats:
    """The rotation matrix about an axis through the origin, by Rodrigues' formula."""
    k = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
    angle = np.radians(degrees)
    turn: Floats = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return turn


def unit_vectors(count: int, seed: int = 0) -> Floats:
    """Random directions."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    units: Floats = v / np.linalg.norm(v, axis=1, keepdims=True)
    return units


# Elasticity by engineering constants and fourth-order tensors, independent of the core's formulas.


def isotropic_tensor(young: float, poisson: float) -> Floats:
    """C_ijkl = λ δ_ij δ_kl + μ (δ_ik δ_jl + δ_il δ_jk)."""
    lame = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    mu = young / (2 * (1 + poisson))
    d = np.eye(3)
    c: Floats = (
        lame * np.einsum("ij,kl->ijkl", d, d)
        + mu * np.einsum("ik,jl->ijkl", d, d)
        + mu * np.einsum("il,jk->ijkl", d, d)
    )
    return c


def fibre_tensor(along: float, across: float, poisson: float, fibre: Floats) -> Floats:
    """C_ijkl of a transversely isotropic tissue: the inverse compliance, turned onto its fibre.

    Compliance with fibre axis 1 (Lekhnitskii 1963): S11 = 1/E_l, S22 = S33 = 1/E_t,
    S12 = S13 = −ν_lt/E_l, S23 = −ν/E_t, S44 = 2(1+ν)/E_t, S55 = S66 = 1/G_lt; ν_lt = ν for the
    stiffer direction along the fibre, else ν E_l/E_t; Saint-Venant 1/G = 1/E_l + 1/E_t + 2ν_lt/E_l.
    """
    nu_lt = poisson if along >= across else poisson * along / across
    s = np.zeros((6, 6))
    s[0, 0] = 1 / along
    s[1, 1] = s[2, 2] = 1 / across
    s[0, 1] = s[1, 0] = s[0, 2] = s[2, 0] = -nu_lt / along
    s[1, 2] = s[2, 1] = -poisson / across
    s[3, 3] = 2 * (1 + poisson) / across
    s[4, 4] = s[5, 5] = 1 / along + 1 / across + 2 * nu_lt / along
    c = voigt_to_tensor(np.linalg.inv(s).astype(np.float64))
    a = np.asarray(fibre, dtype=np.float64)
    b = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
    b /= np.linalg.norm(b)
    frame = np.stack([a, b, np.cross(a, b)], axis=1)
    turned: Floats = np.einsum("ip,jq,kr,ls,pqrs->ijkl", frame, frame, frame, frame, c)
    return turned


def voigt_to_tensor(c: Floats) -> Floats:
    """C_ijkl of a (6, 6) stiffness."""
    out = np.zeros((3, 3, 3, 3))
    for p, (i, j) in enumerate(VOIGT):
        for q, (k, m) in enumerate(VOIGT):
            for ij, km in itertools.product(((i, j), (j, i)), ((k, m), (m, k))):
                out[ij + km] = c[p, q]
    return out


def tensor_to_voigt(c: Floats) -> Floats:
    """The (6, 6) stiffness of C_ijkl."""
    return np.array([[c[ij + km] for km in VOIGT] for ij in VOIGT])


# Integrals over tets by Gauss–Legendre points on the collapsed cube (Duffy 1982), degree 5.


def quadrature(order: int = 4) -> tuple[Floats, Floats]:
    """Barycentric points (q, 4) and weights (q,) that sum to 1."""
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = (x + 1) / 2, w / 2
    u, v, s = (a.ravel() for a in np.meshgrid(x, x, x, indexing="ij"))
    weight = (w[:, None, None] * w[None, :, None] * w[None, None, :]).ravel()
    points = np.stack([u, v * (1 - u), s * (1 - u) * (1 - v)], axis=1)
    weights = 6 * weight * (1 - u) ** 2 * (1 - v)
    return np.column_stack([1 - points.sum(axis=1), points]), weights


def body_loads(nodes: Floats, tets: Indices, density: Callable[[Floats], Floats]) -> Floats:
    """Consistent nodal forces ∫ N_j b dV of a body force b(points), N/mm³."""
    barycentric, weights = quadrature()
    x = np.einsum("qa,mai->mqi", barycentric, nodes[tets])
    b = density(x.reshape(-1, 3)).reshape(x.shape)
    per_tet = np.einsum("m,q,qa,mqi->mai", volumes(nodes, tets), weights, barycentric, b)
    loads = np.zeros_like(nodes)
    np.add.at(loads, tets, per_tet)
    return loads


def l2_error(nodes: Floats, tets: Indices, u: Floats, exact: Callable[[Floats], Floats]) -> float:
    """‖u_h − u‖ / ‖u‖ in L2 over the mesh."""
    barycentric, weights = quadrature()
    x = np.einsum("qa,mai->mqi", barycentric, nodes[tets])
    truth = exact(x.reshape(-1, 3)).reshape(x.shape)
    found = np.einsum("qa,mai->mqi", barycentric, u[tets])
    w = volumes(nodes, tets)[:, None] * weights[None]
    error = np.einsum("mq,mqi->", w, (found - truth) ** 2)
    return float(np.sqrt(error / np.einsum("mq,mqi->", w, truth**2)))


def surface_loads(nodes: Floats, triangles: Indices, traction: Floats) -> Floats:
    """Consistent nodal forces of a uniform traction (MPa) on triangles: a third to each node."""
    a, b, c = (nodes[triangles[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    loads = np.zeros_like(nodes)
    np.add.at(loads, triangles, (area[:, None] / 3 * traction)[:, None, :])
    return loads


def matched(points: Floats, others: Floats) -> NDArray[np.intp]:
    """Index of the nearest of `others` for each point."""
    return np.asarray(cKDTree(others).query(points)[1])
