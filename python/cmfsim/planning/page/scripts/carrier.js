// Points on or near the skin of the mesh, carried with it: as cmfsim.Prediction.carried.
//
// A point keeps its place relative to its closest triangle: x' = c' + R (x − c), with R the
// rotation of the triangle, the polar factor of its tangent map. `share` fades the movement where
// the skin lies away from the tissue that was simulated.

/** Axes and sizes of each triangle in its own plane: 12 numbers, by the triangle's number. */
function planeFrame(frame, nodes, a, b, c) {
  const ux = nodes[b] - nodes[a], uy = nodes[b + 1] - nodes[a + 1], uz = nodes[b + 2] - nodes[a + 2];
  const vx = nodes[c] - nodes[a], vy = nodes[c + 1] - nodes[a + 1], vz = nodes[c + 2] - nodes[a + 2];
  const length = Math.sqrt(ux * ux + uy * uy + uz * uz);
  const ex = ux / length, ey = uy / length, ez = uz / length;
  let nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
  const area = Math.sqrt(nx * nx + ny * ny + nz * nz);
  nx /= area; ny /= area; nz /= area;
  const fx = ny * ez - nz * ey, fy = nz * ex - nx * ez, fz = nx * ey - ny * ex;
  frame[0] = ex; frame[1] = ey; frame[2] = ez;
  frame[3] = fx; frame[4] = fy; frame[5] = fz;
  frame[6] = nx; frame[7] = ny; frame[8] = nz;
  frame[9] = length;
  frame[10] = vx * ex + vy * ey + vz * ez;
  frame[11] = vx * fx + vy * fy + vz * fz;
}

/** What carries `count` points with a skin; the skin before is kept. */
export class Carrier {
  /**
   * nodes (3 n) and triangles (3 t) of the skin before; of each point its triangle, barycentric
   * coordinates (3), offset from the closest point (3, mm) and share.
   */
  constructor(nodes, triangles, { triangle, barycentric, offset, share }) {
    this.nodes = nodes;
    this.triangles = triangles;
    this.points = { triangle, barycentric, offset, share };
    this.after = Float64Array.from(nodes);
    this.turns = new Float64Array(9 * (triangles.length / 3));
    this.used = Uint32Array.from(new Set(triangle)).sort();
    this.rest = new Float64Array(12 * this.used.length);
    const frame = new Float64Array(12);
    this.used.forEach((t, i) => {
      const [a, b, c] = this.corners(t);
      planeFrame(frame, nodes, a, b, c);
      this.rest.set(frame, 12 * i);
    });
  }

  corners(t) {
    const { triangles } = this;
    return [3 * triangles[3 * t], 3 * triangles[3 * t + 1], 3 * triangles[3 * t + 2]];
  }

  /** Writes the displacements of the points, mm, into `out` (3 per point). */
  carry(out, displacements) {
    const { nodes, after, points, triangles, turns } = this;
    for (let i = 0; i < after.length; i++) after[i] = nodes[i] + displacements[i];
    this.turnTriangles();
    const { triangle, barycentric, offset, share } = points;
    for (let p = 0; p < triangle.length; p++) {
      const t = triangle[p], part = share[p], p3 = 3 * p;
      const a = 3 * triangles[3 * t], b = 3 * triangles[3 * t + 1], c = 3 * triangles[3 * t + 2];
      const wa = barycentric[p3], wb = barycentric[p3 + 1], wc = barycentric[p3 + 2];
      const ox = offset[p3], oy = offset[p3 + 1], oz = offset[p3 + 2];
      for (let axis = 0; axis < 3; axis++) {
        const r = 9 * t + 3 * axis;
        const turned = turns[r] * ox + turns[r + 1] * oy + turns[r + 2] * oz;
        out[p3 + axis] = part * (
          wa * displacements[a + axis] + wb * displacements[b + axis] +
          wc * displacements[c + axis] + turned - offset[p3 + axis]
        );
      }
    }
  }

  /** Writes the value of a field of the nodes at each point into `out` (1 per point). */
  interpolate(out, field) {
    const { triangles, points: { triangle, barycentric } } = this;
    for (let p = 0; p < triangle.length; p++) {
      const t = 3 * triangle[p];
      out[p] = 0;
      for (let c = 0; c < 3; c++) out[p] += barycentric[3 * p + c] * field[triangles[t + c]];
    }
  }

  /** The rotation of every triangle that carries a point: F = Q' (A ⊕ 1) Qᵀ, its polar factor. */
  turnTriangles() {
    const { used, rest, after, turns, triangles } = this;
    const now = new Float64Array(12);
    for (let i = 0; i < used.length; i++) {
      const t = used[i];
      planeFrame(now, after, 3 * triangles[3 * t], 3 * triangles[3 * t + 1], 3 * triangles[3 * t + 2]);
      const q = 12 * i;
      const stretch = now[9] / rest[q + 9];
      const shear = (now[10] - rest[q + 10] * stretch) / rest[q + 11];
      const angle = Math.atan2(-shear, stretch + now[11] / rest[q + 11]);
      const cos = Math.cos(angle), sin = Math.sin(angle);
      for (let r = 0; r < 3; r++) {
        const e = cos * now[r] + sin * now[3 + r];
        const f = -sin * now[r] + cos * now[3 + r];
        for (let k = 0; k < 3; k++) {
          turns[9 * t + 3 * r + k] = e * rest[q + k] + f * rest[q + 3 + k] + now[6 + r] * rest[q + 6 + k];
        }
      }
    }
  }
}
